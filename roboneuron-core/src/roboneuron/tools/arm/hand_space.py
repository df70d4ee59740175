"""Space that a hand and objects take, for a hand that points straight down."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import LocatedObject
from roboneuron.sight.marks import told_name
from roboneuron.tools.arm.options import HandOptions

_FAR = 1e3


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class UprightBox:
    """A box that stands upright, base frame.

    Attributes:
        centre: float64 (2,), x and y [m].
        half: float64 (2,), half of its lengths along its own axes [m].
        yaw_rad: direction of its first axis.
        bottom_m, top_m: heights.
        name: what it belongs to, in quotation marks if it is an object.
        uncertainty_m: its place is within this distance.
    """

    centre: F64
    half: F64
    yaw_rad: float
    bottom_m: float
    top_m: float
    name: str = ""
    uncertainty_m: float = 0.0

    @classmethod
    def of(cls, one: LocatedObject) -> UprightBox:
        """The box of an object; of one without a known yaw the largest that it may take."""
        half = one.size_m[:2] / 2
        if one.yaw_rad is None:
            half = np.full(2, float(np.linalg.norm(half)))
        return cls(
            centre=one.position_m[:2],
            half=half,
            yaw_rad=one.yaw_rad or 0.0,
            bottom_m=float(one.position_m[2] - one.size_m[2] / 2),
            top_m=float(one.position_m[2] + one.size_m[2] / 2),
            name=told_name(one),
            uncertainty_m=one.uncertainty_m,
        )

    @property
    def axes(self) -> F64:
        """Its axes as rows (2, 2)."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.array([[c, s], [-s, c]])

    def reach(self, direction: F64) -> float:
        """Half of its extent along a direction (2,) of unit length [m]."""
        return float(self.half @ np.abs(self.axes @ direction))

    def distance_m(self, place_m: F64) -> float:
        """Distance of a place (3,) from it; 0 inside."""
        beside = np.abs(self.axes @ (place_m[:2] - self.centre)) - self.half
        upright = max(self.bottom_m - place_m[2], place_m[2] - self.top_m)
        return float(np.linalg.norm(np.maximum([*beside, upright], 0.0)))


def gap_m(one: UprightBox, other: UprightBox) -> float:
    """Horizontal distance between two boxes, never told too large; negative where they overlap.
    Source: the separating axis theorem, Gottschalk et al., "OBBTree", SIGGRAPH 1996.
    """
    offset = other.centre - one.centre
    return max(
        float(abs(axis @ offset) - one.reach(axis) - other.reach(axis))
        for axis in (*one.axes, *other.axes)
    )


def parts_of_hand(
    position_m: F64, yaw_rad: float, width_m: float, hand: HandOptions
) -> tuple[UprightBox, ...]:
    """Two fingers and the palm of a hand that points down.

    Args:
        position_m: TCP (3,), base frame.
        yaw_rad: direction of its x axis; the fingers close along its y axis.
        width_m: between the fingers.
        hand: measures.
    """
    closing = np.array([np.sin(yaw_rad), -np.cos(yaw_rad)])
    x, y, z = position_m.tolist()
    middle = np.array([x, y])
    half = np.array([hand.finger_width_m, hand.finger_depth_m]) / 2
    fingers = tuple(
        UprightBox(
            centre=middle + side * closing * (width_m + hand.finger_depth_m) / 2,
            half=half,
            yaw_rad=yaw_rad,
            bottom_m=z - hand.tip_m,
            top_m=_FAR,
        )
        for side in (-1.0, 1.0)
    )
    palm = UprightBox(
        centre=middle,
        half=np.array([hand.palm_depth_m, hand.palm_width_m]) / 2,
        yaw_rad=yaw_rad,
        bottom_m=z + hand.palm_above_m,
        top_m=_FAR,
    )
    return (*fingers, palm)


def nearest_obstacle(
    parts: Sequence[UprightBox], others: Iterable[UprightBox]
) -> tuple[float, str]:
    """Least distance between parts that come from above and other boxes [m], less the uncertainty
    of these, and the name of that one; infinite if nothing is in the way.
    """
    gaps = [
        (gap_m(part, other) - other.uncertainty_m, other.name)
        for part in parts
        for other in others
        if other.top_m > part.bottom_m
    ]
    return min(gaps, default=(np.inf, ""))
