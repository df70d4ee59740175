"""Videos of a data set: one file for each camera, with consecutive episodes."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from roboneuron import InvalidInputError, MissingDependencyError, install_command

Codec = Literal["av1", "h264"]
_ENCODERS: dict[Codec, tuple[str, dict[str, str]]] = {
    "av1": ("libsvtav1", {"g": "2", "crf": "30", "preset": "12", "svtav1-params": "lp=1"}),
    "h264": ("libx264", {"g": "2", "crf": "23", "preset": "veryfast"}),
}
"""Source of the values for AV1: lerobot 0.6.1 (a key frame every other frame, so that any frame is
decoded quickly).
"""
_SAMPLED_FRAMES, _SAMPLED_PIXELS = 50, 400


def load_av() -> ModuleType:
    """Import PyAV. Raises MissingDependencyError."""
    try:
        import av  # heavy
    except ImportError as error:
        raise MissingDependencyError(
            "Videos need PyAV.", hint=f"Run: {install_command('rn-recorder[export]')}."
        ) from error
    av.logging.set_level(av.logging.ERROR)
    os.environ.setdefault("SVT_LOG", "1")  # the AV1 encoder writes its settings to stderr otherwise
    return av


@contextmanager
def at_own_priority() -> Iterator[None]:
    """Threads that begin here, and the calling one, keep the scheduling policy that it has.

    Because SVT-AV1 (seen with 4.1.0, as root) gives all of them SCHED_FIFO with the highest
    priority when it is opened: an export would take the CPU from the control loop of an arm on this
    machine.
    """
    if sys.platform != "linux":
        yield
        return
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    tasks = Path("/proc/self/task")
    own = str(threading.get_native_id())
    others = {task.name for task in tasks.iterdir()} - {own}
    try:
        yield
    finally:
        for task in {task.name for task in tasks.iterdir()} - others:
            with suppress(ProcessLookupError):
                if os.sched_getscheduler(int(task)) != policy:
                    os.sched_setscheduler(int(task), policy, parameter)


class CameraVideo:
    """Writes one video and samples pixels for the statistics. Used from one thread.

    Args:
        path: path of the file; its folder is created.
        fps: frames per second.
    """

    def __init__(self, path: Path, fps: int, codec: Codec) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        encoder, options = _ENCODERS[codec]
        self._av = load_av()
        self._container = self._av.open(str(path), "w")
        self._stream = self._container.add_stream(encoder, rate=fps, options=options)
        self._stream.pix_fmt = "yuv420p"
        self._shape: tuple[int, ...] = ()
        self._sampled: list[NDArray[np.float64]] = []
        self._random = np.random.default_rng(0)
        self._in_episode = 0
        self.frames = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W, 3) of its images."""
        return self._shape

    def add(self, image: NDArray[np.uint8], times: int, every: int) -> None:
        """Add an image that is shown for `times` rows; every `every`-th row is sampled for the
        statistics.

        Raises:
            InvalidInputError: its size differs from that of the first one, or is odd.
        """
        if not self._shape:
            if image.shape[0] % 2 or image.shape[1] % 2:
                raise InvalidInputError(
                    f"Images of {image.shape[1]}x{image.shape[0]} px: videos need even sizes."
                )
            self._shape = image.shape
            self._stream.height, self._stream.width = image.shape[:2]
            with at_own_priority():
                self._stream.codec_context.open()
        if image.shape != self._shape:
            raise InvalidInputError(
                f"An image has the shape {image.shape}, the first one had {self._shape}."
            )
        for _ in range(times):
            frame = self._av.VideoFrame.from_ndarray(image, format="rgb24")
            self._container.mux(self._stream.encode(frame))
            if self._in_episode % every == 0:
                flat = image.reshape(-1, 3)
                drawn = self._random.integers(len(flat), size=_SAMPLED_PIXELS)
                self._sampled.append(flat[drawn].astype(np.float64) / 255.0)
            self.frames += 1
            self._in_episode += 1

    def take_sample(self) -> tuple[NDArray[np.float64], int]:
        """Sampled pixels (N, 3) in 0 .. 1 of the episode that ends now, and their number of
        frames.
        """
        sampled, self._sampled, self._in_episode = self._sampled, [], 0
        return np.concatenate(sampled), len(sampled)

    def close(self) -> None:
        """Finish the file."""
        self._container.mux(self._stream.encode())
        self._container.close()


def sample_every(rows: int) -> int:
    """Interval of the sampled rows for that many rows."""
    return max(1, rows // _SAMPLED_FRAMES)
