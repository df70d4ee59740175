"""Images of one camera as frames with their calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from sensor_msgs.msg import CameraInfo, Image

from roboneuron.contract import CameraCalibration, CameraProfile, Frame
from roboneuron.errors import InvalidInputError
from roboneuron.ros.messages import frame_from_message, intrinsics_from_camera_info


class CalibratedCamera:
    """Turns a camera's images into frames.

    Where the camera is mounted comes from the robot's profile; its intrinsics come from the `camera_info` published
    beside the images, and from the profile, scaled to the image, as long as none was published for that image size.
    """

    def __init__(self, profile: CameraProfile) -> None:
        self._profile = profile
        self._shape: tuple[int, ...] = ()
        self._calibrations: dict[tuple[int, int], CameraCalibration | None] = {}
        self._published: dict[tuple[int, int], tuple[float, ...]] = {}

    def set_info(self, message: CameraInfo) -> None:
        """Take the intrinsics of images of this size.

        Raises:
            InvalidInputError: the message holds no calibration.
        """
        size, values = (int(message.width), int(message.height)), tuple(np.asarray(message.k).tolist())
        mounted = self._profile.calibration
        if mounted is None or self._published.get(size) == values:
            return
        self._calibrations[size] = replace(mounted, intrinsics=intrinsics_from_camera_info(message))
        self._published[size] = values

    def to_frame(self, message: Image) -> Frame:
        """sensor_msgs/Image -> Frame; `rgb8` shares the message's memory.

        Raises:
            InvalidInputError: the image is damaged, or of another size than the first one: a camera that changes its
                size is another camera, and what was calibrated for it no longer holds.
        """
        size = (int(message.width), int(message.height))
        if size not in self._calibrations:
            self._calibrations[size] = self._profile.calibration_at(*size)
        frame = frame_from_message(message, self._profile.name, self._calibrations[size])
        shape, expected = frame.image.shape, self._shape or frame.image.shape
        if shape != expected:
            raise InvalidInputError(
                f"Camera {frame.camera!r} changed its image size from {expected[1]}x{expected[0]} to "
                f"{shape[1]}x{shape[0]}; its images are not acted on.",
                hint="Restart perception and inference if that is meant.",
            )
        self._shape = shape
        return frame
