"""Whether a motion still comes nearer to its target."""

from __future__ import annotations

import math

_NEARER = 5e-4
"""Least change [sum of m and rad] that counts as coming nearer."""


class MotionProgress:
    """Tells a motion that is late from one that is stuck: a simulation on a busy machine and an arm
    that its controller slows down arrive later than planned, but they arrive.
    """

    def __init__(self, planned_s: float, longest_s: float, patience_s: float) -> None:
        """`planned_s` is how long the motion is planned to take, `longest_s` how long it may take,
        `patience_s` how long it may come no nearer after `planned_s` [s].
        """
        self._planned_s = self._nearest_s = planned_s
        self._longest_s = longest_s
        self._patience_s = patience_s
        self._nearest = math.inf

    def is_stuck(self, left: float, elapsed_s: float) -> bool:
        """Note the distance that is left [m, rad or their sum] after `elapsed_s`; return whether
        waiting any longer is pointless.
        """
        if left < self._nearest - _NEARER:
            self._nearest, self._nearest_s = left, max(elapsed_s, self._planned_s)
        return elapsed_s > min(self._nearest_s + self._patience_s, self._longest_s)
