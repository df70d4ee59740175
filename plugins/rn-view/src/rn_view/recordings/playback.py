"""Playback state of a recording: position, speed, play and pause. All pages share it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
_BACK_S = 0.5
""""Previous" skips a mark that was passed less than this ago, so that pressing it again goes
further back during playback.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Mark:
    """A moment to jump to.

    Attributes:
        at_s: time since the start of the recording [s].
        text: what happened.
    """

    at_s: float
    text: str


class Playback:
    """Position in a recording, moved by `advance`. Methods may be called from any thread.

    Args:
        title: name of the recording.
        begun_s: wall-clock time of its start [s].
        duration_s: its length [s].
        marks: moments to jump to, oldest first.
    """

    def __init__(
        self, title: str, begun_s: float, duration_s: float, marks: Sequence[Mark]
    ) -> None:
        self.title = title
        self.begun_s = begun_s
        self.duration_s = duration_s
        self.marks = tuple(marks)
        self._lock = threading.Lock()
        self._position_s = 0.0
        self._speed = 1.0
        self._is_playing = False
        self._jumped = True
        self._listeners: list[Callable[[], None]] = []

    @property
    def position_s(self) -> float:
        """Position: time since the start of the recording [s]."""
        return self._position_s

    @property
    def is_playing(self) -> bool:
        """Whether the recording is playing."""
        return self._is_playing

    @property
    def speed(self) -> float:
        """Speed: seconds of the recording per second of real time."""
        return self._speed

    def play(self, *, speed: float | None = None) -> None:
        """Play; from the start if the end was reached. `speed` also holds from now on."""
        with self._lock:
            if self._position_s >= self.duration_s:
                self._position_s, self._jumped = 0.0, True
            self._speed = self._speed if speed is None else speed
            self._is_playing = True

    def pause(self) -> None:
        """Pause at the present position."""
        self._is_playing = False

    def set_speed(self, speed: float) -> None:
        """Set the speed; allowed while playing."""
        self._speed = speed

    def seek(self, position_s: float) -> None:
        """Jump to a position, clipped to the recording."""
        with self._lock:
            self._position_s = min(max(0.0, position_s), self.duration_s)
            self._jumped = True

    def seek_mark(self, step: int) -> Mark | None:
        """Jump to the next mark (1) or the previous one (-1) and pause. Returns the mark; None,
        without a jump, if there is none.
        """
        here_s = self._position_s
        if step > 0:
            found = next((mark for mark in self.marks if mark.at_s > here_s + 1e-6), None)
        else:
            found = next(
                (mark for mark in reversed(self.marks) if mark.at_s < here_s - _BACK_S), None
            )
        if found is not None:
            self.pause()
            self.seek(found.at_s)
        return found

    def advance(self, elapsed_s: float) -> tuple[float, bool]:
        """Advance by `elapsed_s` of real time. Returns the position, and whether a jump led
        to it.
        """
        with self._lock:
            jumped, self._jumped = self._jumped, False
            if self._is_playing and not jumped:
                self._position_s = min(self._position_s + elapsed_s * self._speed, self.duration_s)
                self._is_playing = self._position_s < self.duration_s
            return self._position_s, jumped

    def listen(self, on_jump: Callable[[], None]) -> Callable[[], None]:
        """Call `on_jump` after each jump, before messages of the new position are delivered.
        Returns a function that ends this.
        """
        self._listeners.append(on_jump)
        with self._lock:
            self._jumped = True  # the new listener has no messages yet
        return lambda: self._listeners.remove(on_jump)

    def tell_jump(self) -> None:
        """Call the listeners. The code that delivers the messages calls this."""
        for listener in list(self._listeners):
            listener()
