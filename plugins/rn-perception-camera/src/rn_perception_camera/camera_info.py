"""Validation of the calibration that a camera driver publishes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
from numpy.typing import NDArray

from rn_perception_camera.fit import Size
from rn_perception_camera.lens import Undistortion
from rn_perception_camera.preparation import HALF_PIXEL
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from sensor_msgs.msg import CameraInfo

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraFacts:
    """Content of a CameraInfo, comparable.

    Attributes:
        size: width and height of the images it describes [px].
        k, p: row by row, as in the message (pixel centres at integers).
        model, d: distortion.
        binning, roi_offset: the part of the sensor that was read.
    """

    size: Size
    k: tuple[float, ...]
    p: tuple[float, ...]
    model: str
    d: tuple[float, ...]
    binning: tuple[int, int]
    roi_offset: tuple[int, int]

    @classmethod
    def from_message(cls, message: CameraInfo) -> Self:
        """sensor_msgs/CameraInfo -> facts, unchecked."""
        return cls(
            size=(int(message.width), int(message.height)),
            k=tuple(map(float, message.k)),
            p=tuple(map(float, message.p)),
            model=str(message.distortion_model),
            d=tuple(map(float, message.d)),
            binning=(int(message.binning_x), int(message.binning_y)),
            roi_offset=(int(message.roi.x_offset), int(message.roi.y_offset)),
        )


def read_optics(
    facts: CameraFacts, size: Size, distortion: Literal["refuse", "undistort", "rectified"]
) -> tuple[F64, Undistortion | None]:
    """Intrinsics float64 (3, 3) [px, pixel centres at integers + 0.5] of images of `size`, and
    their undistortion.

    Source: sensor_msgs/CameraInfo: K and D describe the raw image, P the rectified one; zero focal
    lengths mean that the camera was never calibrated.

    Raises:
        ConfigurationError: never calibrated, for another image size, of a part of the sensor, or
            distorted while distortion is refused or of an unknown model.
    """
    if facts.size != size:
        raise ConfigurationError(
            f"It describes {facts.size[0]}x{facts.size[1]} images, they are {size[0]}x{size[1]}.",
            hint="Name the camera_info that belongs to this topic, or calibrate the camera at "
            "this size.",
        )
    if max(facts.binning) > 1 or any(facts.roi_offset):
        raise ConfigurationError(
            f"It describes a part of the sensor (binning {facts.binning}, offset "
            f"{facts.roi_offset}).",
            hint="Let the driver deliver whole images without binning.",
        )
    numbers = (
        facts.k if distortion != "rectified" else (*facts.p[0:3], *facts.p[4:7], *facts.p[8:11])
    )
    intrinsics = np.array(numbers).reshape(3, 3)
    if not np.isfinite(intrinsics).all() or intrinsics[0, 0] <= 0 or intrinsics[1, 1] <= 0:
        which = "p" if distortion == "rectified" else "k"
        raise ConfigurationError(
            f"It holds no calibration: {which} is {list(numbers)}.",
            hint="Calibrate the camera, or leave camera_info out.",
        )
    intrinsics = intrinsics + HALF_PIXEL
    if distortion == "rectified" or not any(facts.d):
        return intrinsics, None
    if distortion == "refuse":
        raise ConfigurationError(
            f"The lens distorts ({facts.model or 'no model'}, d = {list(facts.d)}).",
            hint='Take the rectified topic with distortion = "rectified", or set distortion = '
            '"undistort".',
        )
    if not np.isfinite(facts.d).all():
        raise ConfigurationError(f"Its distortion is not finite: d = {list(facts.d)}.")
    return intrinsics, Undistortion(intrinsics, facts.model, facts.d, width=size[0], height=size[1])
