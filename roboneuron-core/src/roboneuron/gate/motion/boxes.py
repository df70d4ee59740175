"""Boxes and distances in the base frame: how deep a point is where it must not be, and whether a way leads there."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import Pose
from roboneuron.gate.motion.rules import Zone

F64 = NDArray[np.float64]


def distance_m(here: Pose, there: Pose) -> float:
    """Distance of two TCP positions."""
    return math.dist(here.position_m.tolist(), there.position_m.tolist())


def angle_rad(here: Pose, there: Pose) -> float:
    """Angle of the rotation between two TCP orientations, 0 .. pi."""
    cosine = abs(float(np.dot(here.quaternion_xyzw, there.quaternion_xyzw)))
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    return 2.0 * math.atan2(sine, cosine)


def depth_outside_m(point_m: F64, lower_m: F64, upper_m: F64) -> float:
    """How far a point (3,) lies outside a box along the worst axis; negative inside."""
    return float(np.maximum(lower_m - point_m, point_m - upper_m).max())


def is_crossed(zone: Zone, start_m: F64, end_m: F64) -> bool:
    """Whether the straight way from `start_m` to `end_m`, each (3,), touches the box (slab test)."""
    enter, leave = 0.0, 1.0
    for begin, end, low, high in zip(
        start_m.tolist(), end_m.tolist(), zone.lower_m.tolist(), zone.upper_m.tolist(), strict=True
    ):
        way = end - begin
        if way == 0.0:
            if not low < begin < high:
                return False
            continue
        near, far = sorted(((low - begin) / way, (high - begin) / way))
        enter, leave = max(enter, near), min(leave, far)
        if enter >= leave:
            return False
    return True


def breaks_zone(zone: Zone, start_m: F64, end_m: F64) -> bool:
    """Whether the way leads into the zone, or not out of it when it starts there."""
    start_depth = -depth_outside_m(start_m, zone.lower_m, zone.upper_m)
    if start_depth > 0.0:
        return -depth_outside_m(end_m, zone.lower_m, zone.upper_m) >= start_depth
    return is_crossed(zone, start_m, end_m)


def is_worse(end: float, start: float) -> bool:
    """Whether a way ends where it must not (depth > 0) without leading out of there."""
    return end > 0.0 and end >= start
