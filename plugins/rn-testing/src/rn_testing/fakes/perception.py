"""A camera whose images are supplied by the test."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from roboneuron import (
    CameraProfile,
    ConfigurationError,
    Frame,
    NotReadyError,
    PerceptionSpec,
    StateError,
    Topics,
)


def gradient_image(width: int = 64, height: int = 48, shade: int = 0) -> NDArray[np.uint8]:
    """uint8 (height, width, 3): red increases to the right, green downwards, blue is `shade`."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:, :, 0] = np.linspace(0, 255, width, dtype=np.uint8)[None, :]
    image[:, :, 1] = np.linspace(0, 255, height, dtype=np.uint8)[:, None]
    image[:, :, 2] = shade % 256
    return image


class ControlledSource:
    """Follows the protocol `PerceptionSource`; `show` creates the next frame."""

    def __init__(self, config: None, topics: Topics, cameras: Sequence[CameraProfile]) -> None:
        self._topics = topics
        self._cameras = {c.name: c for c in cameras}
        self._pending: deque[Frame] = deque()
        self._changed = threading.Condition()
        self._is_open = False

    def open(self) -> None:
        """Raises ConfigurationError without cameras."""
        if not self._cameras:
            raise ConfigurationError("The source has no camera to serve.")
        self._is_open = True

    def show(
        self, camera: str, image: NDArray[np.uint8] | None = None, stamp_ns: int | None = None
    ) -> None:
        """Make a frame arrive (a gradient if `image` is None); may be called from any thread."""
        profile = self._cameras[camera]
        frame = Frame(
            camera=camera,
            image=gradient_image(profile.width, profile.height) if image is None else image,
            stamp_ns=self._topics.now_ns() if stamp_ns is None else stamp_ns,
            frame_id=profile.frame_id,
            calibration=profile.calibration,
        )
        with self._changed:
            self._pending.append(frame)
            self._changed.notify_all()

    def read(self, timeout_s: float) -> Frame:
        """The oldest unread frame. Raises NotReadyError if none arrives in time, StateError unless
        open.
        """
        with self._changed:
            if not self._is_open:
                raise StateError("The source is not open; call open() first.")
            if not self._changed.wait_for(lambda: self._pending or not self._is_open, timeout_s):
                raise NotReadyError(f"No frame came within {timeout_s:g} s.")
            if not self._is_open:
                raise StateError("The source was closed.")
            return self._pending.popleft()

    def close(self) -> None:
        """Drop unread frames and end a `read` in progress."""
        with self._changed:
            self._is_open = False
            self._pending.clear()
            self._changed.notify_all()


FAKE_PERCEPTION = PerceptionSpec(
    name="controlled",
    summary="Shows what a test tells it to show.",
    target="rn_testing.fakes.perception:ControlledSource",
)
"""Descriptor of the fake camera source."""
