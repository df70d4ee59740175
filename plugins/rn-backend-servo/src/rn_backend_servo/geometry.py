"""Directions of the hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from roboneuron import rotvec_from_matrix

F64 = NDArray[np.float64]


def downward(yaw_rad: float) -> F64:
    """Rotation (3, 3) of a TCP that points straight down (z along -z of the base), its x axis at
    `yaw_rad` from x.
    """
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def yaw_of(rotation: F64) -> float:
    """Angle [rad] of the x axis of `rotation` (3, 3) about the base's z axis."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def quarter_turn_near(angle_rad: float, reference_rad: float) -> float:
    """The angle nearest to `reference_rad` that differs from `angle_rad` by quarter turns: a cube
    has this symmetry.
    """
    quarter = np.pi / 2
    return float(angle_rad + quarter * np.round((reference_rad - angle_rad) / quarter))


def rotation_between(start: F64, goal: F64) -> F64:
    """Rotation vector (3,) [rad] in the base frame that turns `start` (3, 3) into `goal`."""
    return rotvec_from_matrix(goal @ start.T)
