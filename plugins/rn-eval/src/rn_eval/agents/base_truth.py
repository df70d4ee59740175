"""Ground truth of a mobile base in an episode, from the simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
STILL_M_S, STILL_RAD_S = 0.01, 0.02
"""Speeds below which a base counts as standing still."""
MOVED_M, MOVED_RAD = 0.02, 0.05
"""Displacements that a standing base does not reach."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class BaseTruth:
    """Samples of a simulated base, oldest first; empty if it was never started.

    Attributes:
        t_s: float64 (n,), since the agent's start [s]; increasing.
        poses: float64 (n, 3), x [m], y [m] and heading [rad, counter-clockwise, not wrapped],
            relative to its start pose.
        latched_s: as of `rn_eval.agents.truth.Truth`.
    """

    t_s: F64
    poses: F64
    latched_s: tuple[tuple[float, float], ...] = ()

    @property
    def is_empty(self) -> bool:
        """True if the base was never started."""
        return self.t_s.size == 0

    @property
    def end(self) -> tuple[float, float, float]:
        """x [m], y [m] and heading [rad] at the end; zeros if it was never started."""
        x_m, y_m, yaw_rad = (0.0, 0.0, 0.0) if self.is_empty else self.poses[-1]
        return float(x_m), float(y_m), float(yaw_rad)

    def moved(self, from_s: float = -math.inf, to_s: float = math.inf) -> bool:
        """True if the base drove or turned between two times."""
        part = self.poses[(self.t_s >= from_s) & (self.t_s <= to_s)]
        if not part.shape[0]:
            return False
        way = np.abs(part - part[0]).max(axis=0)
        return bool(max(way[0], way[1]) > MOVED_M or way[2] > MOVED_RAD)

    def is_still_at_end(self, for_s: float = 0.3) -> bool:
        """True if the base stood still for the last `for_s` seconds, or was never started."""
        if self.is_empty:
            return True
        last = self.poses[self.t_s >= self.t_s[-1] - for_s]
        way = np.abs(last - last[-1]).max(axis=0)
        return bool(max(way[0], way[1]) <= STILL_M_S * for_s and way[2] <= STILL_RAD_S * for_s)
