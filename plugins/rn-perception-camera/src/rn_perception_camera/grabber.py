"""One thread per camera that grabs images, and reopens the camera after it was unplugged."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_perception_camera.capture import Capture
from roboneuron import InternalError, NotReadyError, RoboNeuronError

Opener = Callable[[], tuple[Capture, float]]

FIRST_RETRY_S = 0.5
LAST_RETRY_S = 8.0
"""Longest interval of attempts to reopen a camera: they begin after 0.5 s, and the interval doubles
each time.
"""
log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Grabbed:
    """A captured image.

    Attributes:
        bgr: uint8 (H, W, 3) in BGR order, in separate memory.
        stamp_ns: ROS time of grabbing [ns].
    """

    bgr: NDArray[np.uint8]
    stamp_ns: int


class Grabber:
    """Grabs from an open capture until it is stopped.

    Args:
        place: the device or file, for messages.
        loop: None for a device; for a file, True to restart at its end.
        opener: opens the camera (again).
        now_ns: ROS time [ns].
        deliver: receives each image.
    """

    def __init__(
        self, place: str, loop: bool | None, opener: Opener, now_ns: Callable[[], int],
        deliver: Callable[[Grabbed], None],
    ) -> None:  # fmt: skip
        self._place = place
        self._loop = loop
        self._opener = opener
        self._now_ns = now_ns
        self._deliver = deliver
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._problem: RoboNeuronError | None = None

    @property
    def problem(self) -> RoboNeuronError | None:
        """Reason why it delivers nothing at the moment, or None."""
        if self._problem is None and self._thread is not None and not self._thread.is_alive():
            return InternalError(
                f"The thread that grabs from {self._place} failed.", hint="See the module's log."
            )
        return self._problem

    def start(self) -> None:
        """Open the camera, and start grabbing on a thread; raises as `opener`."""
        capture, pace_hz = self._opener()
        self._thread = threading.Thread(
            target=self._run, args=(capture, pace_hz), name=f"grab {self._place}", daemon=True
        )
        self._thread.start()

    def ask_to_stop(self) -> None:
        """Request the end of the thread after the present image."""
        self._stop.set()

    def join(self, timeout_s: float) -> bool:
        """Wait for the thread, which releases the camera; return True if it has ended."""
        if self._thread is not None:
            self._thread.join(timeout_s)
        return self._thread is None or not self._thread.is_alive()

    def _run(self, first: Capture, pace_hz: float) -> None:
        capture: Capture | None = first
        retry_s = FIRST_RETRY_S
        while not self._stop.is_set():
            if capture is None:
                try:
                    capture, pace_hz = self._opener()
                except RoboNeuronError as error:
                    self._problem = error
            if capture is not None:
                try:
                    delivered = self._follow(capture, pace_hz)
                finally:
                    capture.release()
                    capture = None
                if delivered:
                    retry_s = FIRST_RETRY_S
                if self._loop and delivered:
                    continue
                if self._loop is not None:
                    self._end_of_file(delivered)
                    return
                if not self._stop.is_set():
                    self._problem = NotReadyError(
                        f"Camera {self._place} delivers no images any more.",
                        hint="Plug it in again; it is then opened by itself.",
                    )
            if self._problem is not None:
                log.warning("%s Trying again in %.1f s.", self._problem, retry_s)
            self._stop.wait(retry_s)
            retry_s = min(2 * retry_s, LAST_RETRY_S)
        if capture is not None:
            capture.release()

    def _follow(self, capture: Capture, pace_hz: float) -> bool:
        """Deliver images until there are none; return True if there was one."""
        delivered = False
        due_s = time.monotonic()
        while not self._stop.is_set():
            if pace_hz > 0:
                due_s = max(due_s + 1.0 / pace_hz, time.monotonic())
            if not capture.grab():
                break
            stamp_ns = self._now_ns()
            intact, bgr = capture.retrieve()
            if not intact:
                break
            delivered = True
            self._problem = None
            self._deliver(Grabbed(bgr=bgr, stamp_ns=stamp_ns))
            if pace_hz > 0:
                self._stop.wait(due_s - time.monotonic())
        return delivered

    def _end_of_file(self, delivered: bool) -> None:
        if delivered:
            self._problem = NotReadyError(
                f"The video {self._place!r} has ended.", hint="Set loop = true to repeat it."
            )
        else:
            self._problem = NotReadyError(
                f"The video {self._place!r} holds no image.", hint="Name another file."
            )
