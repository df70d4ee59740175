"""Grasps from above: what can be grasped, how, and by which route."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from roboneuron.contract import Pose
from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import LocatedObject
from roboneuron.errors import RefusedError
from roboneuron.sight.marks import told_name
from roboneuron.tools.arm.absolute import top_down
from roboneuron.tools.arm.doubt import UnclearError
from roboneuron.tools.arm.hand_space import (
    UprightBox,
    gap_m,
    nearest_obstacle,
    parts_of_hand,
)
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.routes import Waypoint

_CLEAR_M = 0.003
"""Least distance of the open hand from other objects, beyond their uncertainty."""
_PLAY_M = 0.007
"""Play of fingers beside an object to which they open narrowly, on each side, beyond its
uncertainty.
"""
_OVER_M = 0.05
"""Height over all objects at which the hand travels."""
_LIFT_M = 0.12
_FLOOR_M = 0.012


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Grasp:
    """A planned grasp.

    Attributes:
        object: what is grasped.
        position_m: TCP (3,) where the hand closes.
        yaw_rad: of the hand.
        opening: 0 closed .. 1 open, with which it comes down.
        clearance_m: from the nearest other object.
    """

    object: LocatedObject
    position_m: F64
    yaw_rad: float
    opening: float
    clearance_m: float


def grasps_of(
    one: LocatedObject,
    others: Sequence[UprightBox],
    hand: HandOptions,
    present_yaw_rad: float,
    yaw_rad: float | None = None,
) -> list[Grasp]:
    """Possible grasps from above, those with the smallest turn of the hand first.

    Args:
        one: what is to be grasped.
        others: everything else.
        hand: measures.
        present_yaw_rad: of the hand.
        yaw_rad: the only permitted one; None for those across the object's faces.

    Raises:
        RefusedError: rule `too_wide`, `covered`, `too_close`, `unclear`; with the distance.
    """
    box = UprightBox.of(one)
    check_uncovered(box, others)
    if one.yaw_rad is None and yaw_rad is None:
        raise UnclearError(told_name(one), one.uncertainty_m, one.position_m)
    yaws = [box.yaw_rad, box.yaw_rad + np.pi / 2] if yaw_rad is None else [yaw_rad]
    widths = {yaw: 2 * box.reach(np.array([np.sin(yaw), -np.cos(yaw)])) for yaw in yaws}
    fitting = {yaw: width for yaw, width in widths.items() if width <= hand.gap_m - 2e-3}
    if not fitting:
        width = min(widths.values())
        raise RefusedError(
            f"{told_name(one)} is {width * 100:.1f} cm wide between the fingers, which open to "
            f"{hand.gap_m * 100:.1f} cm.",
            rule="too_wide",
        )
    height_m = max(float(one.position_m[2]), box.top_m - hand.deep_m, box.bottom_m + _FLOOR_M)
    position = np.array([*one.position_m[:2], height_m])
    found = [_opened(one, position, yaw, width, others, hand) for yaw, width in fitting.items()]
    free = [grasp for grasp, _ in found if grasp.clearance_m >= _CLEAR_M]
    if not free:
        best, name = max(found, key=lambda pair: pair[0].clearance_m)
        raise RefusedError(
            f"The fingers would be {best.clearance_m * 1000:.0f} mm from {name}, at least "
            f"{_CLEAR_M * 1000:.0f} are needed.",
            hint=f"Move {name} away first: pick or push it.",
            rule="too_close",
        )
    turned = [grasp for one_way in free for grasp in _both_ways(one_way)]
    if yaw_rad is not None:
        turned = free
    return sorted(turned, key=lambda grasp: abs(_turn(present_yaw_rad, grasp.yaw_rad)))


def _opened(
    one: LocatedObject,
    position: F64,
    yaw_rad: float,
    width_m: float,
    others: Sequence[UprightBox],
    hand: HandOptions,
) -> tuple[Grasp, str]:
    """The grasp with the widest opening that is free, else with a narrow one; and the nearest other
    object.
    """
    narrow_m = min(hand.gap_m, width_m + 2 * (one.uncertainty_m + _PLAY_M))
    for open_m in (hand.gap_m, narrow_m):
        parts = parts_of_hand(position, yaw_rad, open_m, hand)
        clearance_m, name = nearest_obstacle(parts, others)
        if clearance_m >= _CLEAR_M:
            break
    grasp = Grasp(
        object=one,
        position_m=position,
        yaw_rad=yaw_rad,
        opening=open_m / hand.gap_m,
        clearance_m=clearance_m,
    )
    return grasp, name


def _both_ways(grasp: Grasp) -> Iterator[Grasp]:
    """The grasp, and with the fingers exchanged."""
    for turn in (0.0, np.pi):
        yield Grasp(
            object=grasp.object,
            position_m=grasp.position_m,
            yaw_rad=_turn(0.0, grasp.yaw_rad + turn),
            opening=grasp.opening,
            clearance_m=grasp.clearance_m,
        )


def _turn(start_rad: float, end_rad: float) -> float:
    return float((end_rad - start_rad + np.pi) % (2 * np.pi) - np.pi)


def check_uncovered(box: UprightBox, others: Sequence[UprightBox]) -> None:
    """Raise RefusedError if something stands on an object."""
    middle_m = (box.bottom_m + box.top_m) / 2
    on_top = [one.name for one in others if one.bottom_m > middle_m and gap_m(box, one) < 0]
    if on_top:
        raise RefusedError(
            f"On {box.name} stands {' and '.join(on_top)}.",
            hint=f"Pick {on_top[0]} first, and place it elsewhere.",
            rule="covered",
        )


def boxes_of(objects: Iterable[LocatedObject]) -> list[UprightBox]:
    """The boxes of objects."""
    return [UprightBox.of(one) for one in objects]


def route_to_grasp(grasp: Grasp, start: Pose, others: Sequence[UprightBox]) -> list[Waypoint]:
    """The route of a pick whose hand is at `start`."""
    tops = [UprightBox.of(grasp.object).top_m, *(box.top_m for box in others)]
    over_m = max(tops) + _OVER_M
    here = np.array(start.position_m)
    travel_m = max(over_m, min(float(here[2]), over_m + 0.1))
    above = np.array([*grasp.position_m[:2], travel_m])
    rotation = top_down(grasp.yaw_rad)
    route = []
    if here[2] < over_m:
        route.append(Waypoint(what="the height above all objects", position_m=_at(here, over_m)))
    name = told_name(grasp.object)
    lifted = _at(grasp.position_m, max(over_m, grasp.position_m[2] + _LIFT_M))
    return [
        *route,
        Waypoint(
            what=f"the place above {name}",
            position_m=above,
            rotation=rotation,
            opening=grasp.opening,
        ),
        Waypoint(
            what=name,
            position_m=grasp.position_m,
            rotation=rotation,
            opening=0.0,
            holds=True,
            done=f"The hand has grasped {name}: place it, it need not be picked again.",
        ),
        Waypoint(what="the lift", position_m=lifted, rotation=rotation, holds=True),
    ]


def _at(position: F64, height_m: float) -> F64:
    return np.array([position[0], position[1], height_m])
