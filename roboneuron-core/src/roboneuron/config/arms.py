"""`[robot.arm]`: an arm that the file declares."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field

from roboneuron.config.section import CameraName, Section


class ArmConfig(Section):
    """`[robot.arm]`: an arm that no plugin offers, by its description; what is not given is guessed
    and named by `roboneuron config arm`.
    """

    urdf: str = Field(
        min_length=1,
        description="its URDF, or the output of xacro; relative to the folder of this file",
    )
    base: str | None = Field(default=None, description="link in whose frame poses are")
    tcp: str | None = Field(default=None, description="link whose z axis points out of the tool")
    joints: tuple[str, ...] = Field(
        default=(), strict=False, description="joints that are driven, base to tip"
    )
    gripper: str | None = Field(
        default=None, description="joint of the gripper; none: it has no gripper"
    )
    home: tuple[Annotated[float, Field(allow_inf_nan=False)], ...] = Field(
        default=(),
        strict=False,
        description="posture to start from, one value for each joint [rad or m]; when not given "
        "it is searched for at each start, which takes up to a second or two",
    )
    package_paths: tuple[str, ...] = Field(
        default=(), strict=False, description="folders with the ROS packages of its meshes"
    )
    cameras: tuple[CameraName, ...] = Field(
        default=("front",),
        strict=False,
        description="names of its cameras; the first has the role primary, others that of their "
        "name",
    )

    def beside(self, folder: Path) -> Self:
        """The declaration with its paths, as far as they are relative, in `folder`."""
        paths = tuple(str(folder / path) for path in self.package_paths)
        return self.model_copy(update={"urdf": str(folder / self.urdf), "package_paths": paths})
