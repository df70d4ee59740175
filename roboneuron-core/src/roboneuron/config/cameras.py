"""`[robot.cameras.<name>]`: the measured calibration of one of the robot's cameras."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from roboneuron.config.section import Point, Section

_SIDE_PX = Annotated[int, Field(ge=1, le=8192)]
_UNIT_SLACK = 1e-3
"""How far the length of a quaternion may be from 1: that of four decimals."""


class CameraConfig(Section):
    """A pinhole camera at a measured pose, as `CameraCalibration`; lists where that has arrays."""

    mount: Annotated[str, Field(pattern=r"^(base|([A-Za-z0-9_-]+/)?tcp)$")] = Field(
        description="what it is fixed to: base, tcp (of several arms the first one's), or <arm>/tcp"
    )
    position_m: Point = Field(description="origin of its optical frame in the frame of its mount")
    quaternion_xyzw: list[float] = Field(
        min_length=4,
        max_length=4,
        description="orientation of its optical frame there: z forwards, x right, y down",
    )
    size: list[_SIDE_PX] | None = Field(
        default=None,
        min_length=2,
        max_length=2,
        description="width and height of the pictures that intrinsics describe [px]",
    )
    intrinsics: list[float] | None = Field(
        default=None,
        min_length=4,
        max_length=4,
        description="fx, fy, cx, cy [px] without distortion, pixel centres at integers as OpenCV "
        "and ROS have them; those of the robot's profile when not given",
    )

    @model_validator(mode="after")
    def _check_values(self) -> Self:
        length = math.hypot(*self.quaternion_xyzw)
        if not abs(length - 1.0) <= _UNIT_SLACK:
            raise ValueError(f"quaternion_xyzw has length {length:g}, expected 1")
        if (self.size is None) != (self.intrinsics is None):
            raise ValueError("size and intrinsics go together")
        if self.intrinsics is not None and min(self.intrinsics[:2]) <= 0:
            raise ValueError(f"focal lengths are {self.intrinsics[:2]}, expected more than 0")
        return self
