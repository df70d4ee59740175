"""The correction that a person adds to the actions of a policy."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rn_standard.teleoperation.samples import F64

_MOST_M, _MOST_RAD = 0.08, 0.4
"""Farther from where the policy would be its images mean nothing to it: take over instead."""


@dataclass(kw_only=True, slots=True)
class Correction:
    """A displacement of the TCP that grows while the person pushes, and is gone once they let go.

    Attributes:
        is_kept: the policy says where to be, so that a displacement is added to each of its
            actions; otherwise only what was asked since the action before.
    """

    is_kept: bool = False
    _offset: F64 = field(default_factory=lambda: np.zeros(6))

    def add(self, twist: F64, step_s: float) -> F64:
        """Displacement (6,) in the base [m, rad] for the next action.

        Args:
            twist: float64 (6,) [m/s, rad/s].
            step_s: time of that action [s].
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
        """The person lets go."""
        self._offset = np.zeros(6)
