"""Options a user may set under `[plugins.ros-camera]` and `[plugins.video-camera]`."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_perception_camera.nested import PATH_PATTERN, TYPE_PATTERN
from roboneuron import ConfigurationOnly

SIDE_PX = Annotated[int, Field(ge=1, le=8192)]


def check_coefficients(distortion: tuple[float, ...]) -> None:
    """Raise ValueError unless these are distortion coefficients of OpenCV."""
    if len(distortion) not in (4, 5, 8):
        raise ValueError(f"distortion has {len(distortion)} values, expected 4, 5 or 8")
    if not all(map(math.isfinite, distortion)):
        raise ValueError("distortion must be finite")


class ResizeOptions(BaseModel):
    """Size of the output images, and the explicit treatment of the aspect ratio."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    width: int = Field(ge=1, le=8192, description="width of the images that leave [px]")
    height: int = Field(ge=1, le=8192, description="height of the images that leave [px]")
    fit: Literal["letterbox", "crop"] = Field(
        description="letterbox: all of the image, with black bars; crop: the middle of the image, "
        "without bars"
    )


class _CameraOptions(BaseModel):
    """Options common to all cameras."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    resize: ResizeOptions | None = Field(
        default=None, description="another size for its images; theirs when not given"
    )
    max_rate_hz: float | None = Field(
        default=None,
        gt=0,
        le=1000,
        description="most images per second; the newest are kept; no bound when not given",
    )

    @property
    def period_s(self) -> float:
        """Shortest time between two images [s]; 0 for no bound."""
        return 0.0 if self.max_rate_hz is None else 1.0 / self.max_rate_hz


class RosCameraOptions(_CameraOptions):
    """Topics of one camera's images, and the processing of the images."""

    topic: Annotated[str, ConfigurationOnly()] = Field(
        min_length=1, description="topic of the images; absolute, or in the robot's namespace"
    )
    transport: Literal["raw", "compressed"] = Field(
        default="raw",
        description="raw: sensor_msgs/Image; compressed: sensor_msgs/CompressedImage, JPEG or PNG",
    )
    type: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None,
        pattern=TYPE_PATTERN,
        description="type of a topic whose messages hold the image, such as rig_msgs/msg/Views",
    )
    field: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None,
        pattern=PATH_PATTERN,
        description="the image in a message of that type, such as views[0].picture",
    )
    camera_info: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None,
        min_length=1,
        description="topic of its calibration; that of the robot's profile when not given",
    )
    depth: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None,
        min_length=1,
        description="topic of its depth, registered to the images and stamped like them: "
        "sensor_msgs/Image, 16UC1 [mm] or 32FC1 [m]",
    )
    distortion: Literal["refuse", "undistort", "rectified"] | tuple[float, ...] = Field(
        default="refuse",
        description="a lens that camera_info says distorts: refuse it, undistort the images, or "
        "rectified: the driver has done so already; without camera_info coefficients as OpenCV "
        "gives them, to undistort images by with the robot's intrinsics",
    )
    stamp: Literal["capture", "arrival"] = Field(
        default="capture",
        description="capture: the driver's stamps, refused when unset; arrival: time of arrival",
    )
    frame_id: Literal["driver", "profile"] = Field(
        default="driver",
        description="name of the optical frame: the driver's, or the one in the robot's profile",
    )

    @model_validator(mode="after")
    def _check_pairs(self) -> Self:
        if (self.type is None) != (self.field is None):
            raise ValueError("type and field go together: the image is the field of that type")
        measured = None if isinstance(self.distortion, str) else self.distortion
        if measured is not None:
            check_coefficients(measured)
            if self.camera_info is not None:
                raise ValueError("distortion has coefficients, and so has camera_info: drop one")
        elif self.distortion != "refuse" and self.camera_info is None:
            raise ValueError(
                f'distortion = "{self.distortion}" needs camera_info, which tells the distortion'
            )
        if self.depth is not None and (measured is not None or self.distortion == "undistort"):
            raise ValueError("depth is not undistorted: use rectified images, registered to it")
        return self


class RosCamerasOptions(BaseModel):
    """Options of the source `ros-camera`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    cameras: dict[str, RosCameraOptions] = Field(
        min_length=1, description="a table for each camera of the robot, by its name"
    )


class VideoCameraOptions(_CameraOptions):
    """One device or one file."""

    device: Annotated[int | str | None, ConfigurationOnly()] = Field(
        default=None,
        description="number of a V4L2 device, its path such as /dev/v4l/by-id/..., or its card "
        "name, as `roboneuron robot cameras list` shows them",
    )
    path: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None, min_length=1, description="a video file, instead of a device"
    )
    size: tuple[SIDE_PX, SIDE_PX] | None = Field(
        default=None,
        description="width and height to capture [px]; the device's own when not given; devices "
        "only",
    )
    fps: float | None = Field(
        default=None,
        gt=0,
        le=1000,
        description="images per second: asked of a device, pace of a file; their own else",
    )
    fourcc: str | None = Field(
        default=None,
        pattern=r"^[\x20-\x7e]{4}$",
        description="pixel format asked of a device, such as MJPG or YUYV",
    )
    loop: bool = Field(default=False, description="begin a file again at its end")
    intrinsics: tuple[float, float, float, float] | None = Field(
        default=None,
        description="fx, fy, cx, cy [px] at the captured size, pixel centres at integers as "
        "OpenCV and ROS have them;"
        " those of the robot's profile when not given",
    )
    distortion: tuple[float, ...] | None = Field(
        default=None,
        description="k1, k2, p1, p2, k3 or eight rational coefficients, as OpenCV gives them, to "
        "undistort images by, with intrinsics or those of the robot's profile",
    )

    @model_validator(mode="after")
    def _check_whole(self) -> Self:
        if (self.device is None) == (self.path is None):
            raise ValueError("give either device or path")
        if isinstance(self.device, int) and self.device < 0:
            raise ValueError(f"device is {self.device}, expected 0 or more")
        if self.path is not None and (self.size is not None or self.fourcc is not None):
            raise ValueError(
                "size and fourcc are for devices; give a file's images another size with resize"
            )
        if self.device is not None and self.loop:
            raise ValueError("loop is for files")
        if self.distortion is not None:
            check_coefficients(self.distortion)
        if not all(map(math.isfinite, self.intrinsics or ())):
            raise ValueError("intrinsics must be finite")
        if self.intrinsics is not None and min(self.intrinsics[:2]) <= 0:
            raise ValueError(f"focal lengths are {self.intrinsics[:2]}, expected more than 0")
        return self

    @property
    def place(self) -> str:
        """Name of the device or file in messages."""
        if self.path is not None:
            return self.path
        return f"/dev/video{self.device}" if isinstance(self.device, int) else str(self.device)


class VideoCamerasOptions(BaseModel):
    """Options of the source `video-camera`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    cameras: dict[str, VideoCameraOptions] = Field(
        min_length=1, description="a table for each camera of the robot, by its name"
    )
