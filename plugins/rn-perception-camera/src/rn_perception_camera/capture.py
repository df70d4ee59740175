"""Opening a device or a video file with OpenCV."""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rn_perception_camera.devices import node_of, video_devices
from rn_perception_camera.options import VideoCameraOptions
from roboneuron import ConfigurationError, NotReadyError

HANG_LIMIT_S = 1
"""OpenCV's timeout for an image of a silent V4L2 device."""


class Capture(Protocol):
    """Used parts of `cv2.VideoCapture`."""

    def isOpened(self) -> bool:
        """True if it could be opened."""
        ...

    def set(self, propId: int, value: float) -> bool:
        """Request a property's value; check the effect with `get`, not with the result."""
        ...

    def grab(self) -> bool:
        """Wait for the next image; False if there is none."""
        ...

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        """Decode the grabbed image: uint8 (H, W, 3) in BGR order, in separate memory."""
        ...

    def get(self, propId: int) -> float:
        """A property's value."""
        ...

    def release(self) -> None:
        """Close."""
        ...


def open_capture(options: VideoCameraOptions) -> tuple[Capture, float]:
    """Open a device or file; return it with the rate of its images [1/s], 0 for a device, which has
    its own.

    Raises:
        NotReadyError: the device is absent, busy, or not accessible.
        ConfigurationError: the file is absent or not a video, its rate is unknown, or the device
            lacks the size.
    """
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(HANG_LIMIT_S))
    import cv2  # heavy

    if options.path is not None:
        return _open_file(cv2, options.path, options.fps)
    return _open_device(cv2, options, options.device or 0), 0.0


def _open_file(cv2: ModuleType, path: str, fps: float | None) -> tuple[Capture, float]:
    if not Path(path).is_file():
        raise ConfigurationError(
            f"There is no video file {path!r}.", hint="Correct the option path."
        )
    capture = cv2.VideoCapture(path)
    if not capture.isOpened():
        capture.release()
        raise ConfigurationError(f"The file {path!r} is no video that OpenCV can read.")
    pace_hz = fps or float(capture.get(cv2.CAP_PROP_FPS))
    if not 0.0 < pace_hz <= 1000.0:
        capture.release()
        raise ConfigurationError(
            f"The video {path!r} does not tell its pace.", hint="Set the option fps."
        )
    return capture, pace_hz


def _open_device(cv2: ModuleType, options: VideoCameraOptions, device: int | str) -> Capture:
    capture: Capture = cv2.VideoCapture(node_of(device), cv2.CAP_V4L2)
    if not capture.isOpened():
        capture.release()
        raise _explain_absence(options.place)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # older images are of no use
    if options.fourcc is not None:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*options.fourcc))
    if options.size is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, options.size[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, options.size[1])
    if options.fps is not None:
        capture.set(cv2.CAP_PROP_FPS, options.fps)
    size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    if options.size is not None and size != options.size:
        capture.release()
        raise ConfigurationError(
            f"Camera {options.place} was asked for {options.size[0]}x{options.size[1]} and gives "
            f"{size[0]}x{size[1]}.",
            hint="Ask for a size that `v4l2-ctl --list-formats-ext` shows, and use resize for "
            "others.",
        )
    return capture


def _explain_absence(place: str) -> NotReadyError:
    if place.startswith("/") and not Path(place).exists():
        present = ", ".join(one.name for one in video_devices()) or "none"
        return NotReadyError(
            f"There is no camera {place}; V4L2 devices present: {present}.",
            hint="Plug it in, or correct the option device.",
        )
    return NotReadyError(
        f"Camera {place} cannot be opened.",
        hint="End the program that uses it, or let the user who runs this read it (group 'video').",
    )
