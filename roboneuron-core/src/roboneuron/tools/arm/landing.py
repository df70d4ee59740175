"""Where an object lies after it was put down, compared with where it was to be."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import LocatedObject
from roboneuron.errors import StateError
from roboneuron.sight.marks import CellLook, name_of, nearest_like, told_name
from roboneuron.sight.sightlines import is_seen_well, may_be_at

MISS_M = 0.02
"""Largest distance of an object from where it was to be, beyond its uncertainty."""


class MissedError(StateError):
    """The hand let go, but the object lies elsewhere than asked for.

    Attributes:
        lies_at_m: its middle as seen afterwards, base frame [m].
        off_m: distance from where it was to be.
    """

    code: ClassVar[str] = "missed"

    def __init__(self, name: str, meant_m: F64, lies_at_m: F64) -> None:
        """Args:
        name: of the object, in quotation marks.
        meant_m, lies_at_m: where its middle was to be, and is seen (3,).
        """
        self.lies_at_m = np.round(lies_at_m, 3).tolist()
        self.off_m = float(np.linalg.norm(lies_at_m - meant_m))
        super().__init__(
            f"{name} was let go for {np.round(meant_m, 3).tolist()} m, but lies at "
            f"{self.lies_at_m} m now, {self.off_m * 1000:.0f} mm away: it slipped, or fell off.",
            hint="Pick it up and place it again, slower.",
        )


def landed(
    before: CellLook, after: CellLook, one: LocatedObject, meant_m: F64
) -> LocatedObject | None:
    """The object that was put down, as it is seen; None if it is not seen well enough to tell.

    Args:
        before, after: looks before the release, and now.
        one: the object.
        meant_m: where its middle was to be (3,).

    Raises:
        MissedError: it lies elsewhere.
    """
    alike = [
        other for other in before.objects if other is not one and name_of(other) == name_of(one)
    ]
    left = [
        other
        for other in after.objects
        if not any(np.linalg.norm(other.position_m - was.position_m) < MISS_M for was in alike)
    ]
    seen = nearest_like(left, replace(one, position_m=meant_m), np.inf)
    if seen is None:
        return None
    off_m = float(np.linalg.norm(seen.position_m - meant_m))
    is_clear = is_seen_well(seen)
    if is_clear and off_m <= MISS_M + seen.uncertainty_m:
        return seen
    is_higher = seen.is_height_assumed and meant_m[2] - seen.position_m[2] > MISS_M / 2
    if (is_higher or not is_clear) and may_be_at(seen, meant_m, after.view.images):
        return None  # one camera alone, or a part of it, tells no height
    raise MissedError(told_name(one), meant_m, seen.position_m)
