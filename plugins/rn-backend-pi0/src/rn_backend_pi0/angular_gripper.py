"""ALOHA's gripper in the base models of pi0: they use the motor's angle, while ALOHA's own software
uses the finger's travel (state) and the fraction of the motor's travel (command).

Source: Interbotix and ALOHA constants, openpi's policy of ALOHA; `tests/data/action-spaces` holds
its reference values.
"""

from __future__ import annotations

import numpy as np

from rn_vla.rotation import F64

_TRAVEL_M = (0.01844, 0.05800)
"""Position of a finger of the follower arm, closed and open, in the linkage's coordinate."""
_HORN_M = 0.022
_ROD_M = 0.036
"""Radius of the motor's horn and length of the rod to the finger."""
_TRAINED_RAD = (0.5476, 1.6296)
"""Motor angles that pi0's data encodes as 0 and 1: encoder counts 2405 and 3110 of 4096, zero at
2048.
"""
_MOTOR_RAD = (-0.6213, 1.4910)
"""Motor angles that the commands of ALOHA's software encode as 0 and 1."""


def from_opening(opening: F64) -> F64:
    """Convert a measured opening, 0 closed..1 open by the finger's travel, to pi0's fraction of the
    angle.
    """
    low, high = _TRAVEL_M
    travel_m = opening * (high - low) + low
    # Law of cosines in the triangle of horn, rod and finger.
    cosine = (_HORN_M**2 + travel_m**2 - _ROD_M**2) / (2 * _HORN_M * travel_m)
    angle_rad = np.arcsin(np.clip(cosine, -1.0, 1.0))
    least, most = _TRAINED_RAD
    return np.asarray((angle_rad - least) / (most - least), dtype=np.float64)


def to_opening(value: F64) -> F64:
    """Convert pi0's gripper action [rad above its smallest angle] to ALOHA's command, 0 closed..1
    open.
    """
    least, most = _MOTOR_RAD
    return np.asarray((value + _TRAINED_RAD[0] - least) / (most - least), dtype=np.float64)
