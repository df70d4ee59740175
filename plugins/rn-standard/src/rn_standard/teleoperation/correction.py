"""Correction by a person, added to the actions of a policy."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rn_standard.teleoperation.samples import F64

_MOST_M, _MOST_RAD = 0.08, 0.4
"""Largest correction: with a larger one the policy's images would be out of its training range, so
the person should take over.
"""


@dataclass(kw_only=True, slots=True)
class Correction:
    """A displacement of the TCP that grows while the person pushes, and disappears on release.

    Attributes:
        is_kept: the policy's targets are absolute, so the whole displacement is added to each of
            its actions; otherwise only the part since the previous action.
    """

    is_kept: bool = False
    _offset: F64 = field(default_factory=lambda: np.zeros(6))

    def add(self, twist: F64, step_s: float) -> F64:
        """Displacement (6,) in the base [m, rad] for the next action.

        Args:
            twist: float64 (6,) [m/s, rad/s].
            step_s: duration of that action [s].
        """
        step = twist * step_s
        if not self.is_kept:
            return step
        offset = self._offset + step
        for part, most in ((slice(0, 3), _MOST_M), (slice(3, 6), _MOST_RAD)):
            length = float(np.linalg.norm(offset[part]))
            if length > most:
                offset[part] *= most / length
        self._offset = offset
        return offset.copy()

    def reset(self) -> None:
        """Discard the correction, because the person has released the device."""
        self._offset = np.zeros(6)
