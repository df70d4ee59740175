"""Where the commands sent so far should have brought the arm: the reference for the next one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


class CommandedMotion:
    """The last command as a straight line through joint space, passed evenly in its time; used from one thread.

    Args:
        immediate: commands carry no time, so that the robot may jump to them (JointState commands).
    """

    def __init__(self, *, immediate: bool) -> None:
        self._immediate = immediate
        self._start: F64 | None = None
        self._way: F64 = np.zeros(0)
        self._duration_s = 1.0
        self._sent_s = 0.0

    def rest(self, position: F64, now_s: float) -> None:
        """The arm was told to stay at `position`."""
        self.go(position, np.zeros_like(position), 1.0, now_s)

    def go(self, start: F64, way: F64, duration_s: float, now_s: float) -> None:
        """The arm was told to leave `start` and to have gone `way` after `duration_s`."""
        self._start, self._way, self._duration_s, self._sent_s = start, way, duration_s, now_s

    def forget(self) -> None:
        """Nothing is known."""
        self._start = None

    def passed_s(self, now_s: float) -> float:
        """Time since the last command; infinite when there was none."""
        return np.inf if self._start is None else now_s - self._sent_s

    def at(self, now_s: float) -> tuple[F64, F64] | None:
        """Position and velocity at `now_s`, or None when nothing was commanded."""
        if self._start is None:
            return None
        passed = (now_s - self._sent_s) / self._duration_s
        if self._immediate:
            # The way was chosen for the time before it; the arm has that velocity until its next command is due.
            velocity = self._way / self._duration_s if passed <= 2.0 else np.zeros_like(self._way)
            return self._start + self._way, velocity
        if passed >= 1.0:
            return self._start + self._way, np.zeros_like(self._way)
        return self._start + self._way * max(passed, 0.0), self._way / self._duration_s
