"""The rectangle of least area around points on a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roboneuron.contract.arrays import F64

_QUARTER = np.pi / 2
_COARSE, _FINE = 45, 21
"""Directions that are tried in a quarter turn, and around the best of them."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Footprint:
    """A rectangle in the plane.

    Attributes:
        centre_m: float64 (2,).
        yaw_rad: direction of its first side, -pi/4 <= yaw < pi/4.
        size_m: float64 (2,), along its first and second side.
    """

    centre_m: F64
    yaw_rad: float
    size_m: F64

    def holds(self, place_m: F64, margin_m: float) -> bool:
        """True if a place (2,) is inside, or at most `margin_m` beside it."""
        off = _turn(self.yaw_rad).T @ (place_m - self.centre_m)
        return bool((np.abs(off) <= self.size_m / 2 + margin_m).all())


def footprint_of(points_m: F64) -> Footprint:
    """The smallest rectangle around points (n, 2), n >= 1."""
    turns: F64 = np.arange(_COARSE, dtype=np.float64) * (_QUARTER / _COARSE)
    best = _best_turn(points_m, turns)
    near: F64 = np.linspace(-1.0, 1.0, _FINE) * (_QUARTER / _COARSE)
    best = _best_turn(points_m, best + near)
    yaw = float((best + _QUARTER / 2) % _QUARTER - _QUARTER / 2)
    own = points_m @ _turn(yaw)
    low, high = own.min(axis=0), own.max(axis=0)
    return Footprint(
        centre_m=_turn(yaw) @ ((low + high) / 2), yaw_rad=yaw, size_m=np.asarray(high - low)
    )


def _turn(yaw_rad: float) -> F64:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])


def _best_turn(points_m: F64, yaws_rad: F64) -> float:
    """The direction of least area."""
    c, s = np.cos(yaws_rad), np.sin(yaws_rad)
    x, y = points_m[:, :1], points_m[:, 1:]
    along, across = x * c + y * s, y * c - x * s
    area = np.ptp(along, axis=0) * np.ptp(across, axis=0)
    return float(yaws_rad[int(np.argmin(area))])
