"""Objects that a motion has displaced, from the looks before and after it."""

from __future__ import annotations

import numpy as np

from rn_standard.sight.locator import LocatedObject
from rn_standard.sight.marks import CellLook, name_of, nearest_like
from roboneuron import (
    Result,
)

MOVED_M, FOLLOW_M = 0.003, 0.15
"""Least displacement of another object that is told, and the largest that is recognised."""


class MovedObject(Result):
    """Another object that is elsewhere than before."""

    object: str
    by_m: float


def displaced(
    before: CellLook, after: CellLook, carried: LocatedObject | None
) -> tuple[list[MovedObject], list[str]]:
    """Other objects that are elsewhere than before, and those that are no longer seen."""
    moved: list[MovedObject] = []
    lost: list[str] = []
    left = list(after.objects)
    if carried is not None:
        held = nearest_like(left, carried, np.inf)
        alike = [one for one in before.objects if name_of(one) == name_of(carried)]
        if held is not None and len(alike) == 1:
            left.remove(held)
    for one in before.objects:
        if one is carried:
            continue
        again = nearest_like(left, one, FOLLOW_M)
        if again is None:
            lost.append(name_of(one))
            continue
        left.remove(again)
        by_m = float(np.linalg.norm(again.position_m - one.position_m))
        doubt_m = float(np.hypot(one.uncertainty_m, again.uncertainty_m))
        if by_m > max(MOVED_M, doubt_m):
            moved.append(MovedObject(object=name_of(one), by_m=round(by_m, 4)))
    return moved, lost
