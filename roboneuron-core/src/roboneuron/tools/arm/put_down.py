"""Where what the hand holds is put down: at a position, on an object or beside one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from roboneuron.contract import Pose
from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import LocatedObject
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.sight.looker import Looker, seen_target
from roboneuron.sight.marks import CellLook, name_of, told_name
from roboneuron.tools.arm.absolute import top_down, yaw_of
from roboneuron.tools.arm.hand_space import (
    UprightBox,
    gap_m,
    nearest_obstacle,
    parts_of_hand,
)
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.routes import Waypoint

Side = Literal["+x", "-x", "+y", "-y"]
SIDES: dict[Side, F64] = {
    "+x": np.array([1.0, 0.0]),
    "-x": np.array([-1.0, 0.0]),
    "+y": np.array([0.0, 1.0]),
    "-y": np.array([0.0, -1.0]),
}
_RELEASE_M = 0.002
"""Height of the release above that of contact: it is dropped slightly rather than pressed."""
_PLAY_M = 0.007
_CLEAR_M = 0.003
_APART_M = 0.002
"""Least distance of what is put down from other objects, beyond their uncertainty."""
_OVER_M = 0.04
_LEAVE_M = 0.08
_IN_HAND_M = 0.06
_BORNE = 0.5
"""Least part of the shorter edge below by which an object must be carried at its middle."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class HeldObject:
    """What a hand holds.

    Attributes:
        object: as it was seen before the grasp, or in the hand.
        below_m: its bottom below the TCP.
        turn_rad: its yaw less that of the hand; None if it is not known.
        offset_m: its middle from the TCP along x and y of the hand (2,).
        is_origin_known: `object` is as it was seen before the grasp.
    """

    object: LocatedObject
    below_m: float
    turn_rad: float | None
    offset_m: F64
    is_origin_known: bool = True

    @classmethod
    def seen(cls, one: LocatedObject, position_m: F64, yaw_rad: float) -> HeldObject:
        """An object with the TCP (3,) at a place, the hand at a yaw."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        return cls(
            object=one,
            below_m=float(position_m[2] - one.position_m[2] + one.size_m[2] / 2),
            turn_rad=None if one.yaw_rad is None else one.yaw_rad - yaw_rad,
            offset_m=np.array([[c, s], [-s, c]]) @ (one.position_m[:2] - position_m[:2]),
        )

    def at(self, pose: Pose) -> LocatedObject:
        """The object with the TCP at a pose."""
        yaw = yaw_of(matrix_from_quaternion(pose.quaternion_xyzw))
        c, s = np.cos(yaw), np.sin(yaw)
        middle = pose.position_m[:2] + np.array([[c, -s], [s, c]]) @ self.offset_m
        height_m = float(pose.position_m[2]) - self.below_m + float(self.object.size_m[2]) / 2
        return replace(
            self.object,
            position_m=np.array([*middle, height_m]),
            yaw_rad=None if self.turn_rad is None else yaw + self.turn_rad,
            uncertainty_m=max(_IN_HAND_M / 4, self.object.uncertainty_m),
            is_whole=False,
            is_height_assumed=False,
        )

    def box(self, middle: F64, hand_yaw_rad: float, bottom_m: float) -> UprightBox:
        """The box that it takes with its middle (2,) at a place and the hand at a yaw."""
        yaw = None if self.turn_rad is None else hand_yaw_rad + self.turn_rad
        height_m = float(self.object.size_m[2])
        at = np.array([*middle, bottom_m + height_m / 2])
        return UprightBox.of(replace(self.object, position_m=at, yaw_rad=yaw, uncertainty_m=0.001))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlaceTarget:
    """Where to put it.

    Attributes:
        middle: float64 (2,), of the object.
        yaw_rad: of the object, or of the hand if `is_hand_yaw`; None keeps that of the hand.
        on: the object that shall carry it; None for what is found there.
        beside: the one that it is put beside.
    """

    middle: F64
    yaw_rad: float | None = None
    is_hand_yaw: bool = False
    on: LocatedObject | None = None
    beside: LocatedObject | None = None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Descent:
    """A planned release.

    Attributes:
        position_m: TCP (3,).
        yaw_rad: of the hand.
        opening: 0 closed .. 1 open, with which it lets go.
        object_m: float64 (3,), where the middle of the object will be.
        clearance_m: of the hand from the nearest other object.
    """

    position_m: F64
    yaw_rad: float
    opening: float
    object_m: F64
    clearance_m: float


def held_in_view(look: CellLook, pose: Pose) -> HeldObject | None:
    """What is seen well between the fingers of a hand at a pose; None if nothing is."""
    near = [
        (float(np.linalg.norm(one.position_m - pose.position_m)), number, one)
        for number, one in enumerate(look.objects)
        if look.is_certain(one)
    ]
    found = min(near, default=None)
    if found is None or found[0] > _IN_HAND_M:
        return None
    yaw = yaw_of(matrix_from_quaternion(pose.quaternion_xyzw))
    held = HeldObject.seen(found[2], np.array(pose.position_m), yaw)
    return replace(held, is_origin_known=False)


def others_than(look: CellLook, held: HeldObject, pose: Pose) -> list[LocatedObject]:
    """All objects but the one in the hand."""
    return [
        one
        for one in look.objects
        if name_of(one) != name_of(held.object)
        or np.linalg.norm(one.position_m - pose.position_m) > _IN_HAND_M
    ]


def beside(
    one: LocatedObject, held: HeldObject, side: Side, gap: float, hand_yaw_rad: float
) -> PlaceTarget:
    """The target beside an object, parallel to it: on its face that points to a side most.

    Args:
        one: the object.
        held: what is put down.
        side: direction in the base frame.
        gap: between the faces [m].
        hand_yaw_rad: present yaw of the hand.
    """
    box = UprightBox.of(one)
    faces = [sign * axis for axis in box.axes for sign in (1.0, -1.0)]
    if one.yaw_rad is None:
        faces = [SIDES[side]]
    face = max(faces, key=lambda axis: float(axis @ SIDES[side]))
    yaw = None if one.yaw_rad is None or held.turn_rad is None else one.yaw_rad
    turned = hand_yaw_rad if yaw is None else yaw - (held.turn_rad or 0.0)
    reach_m = held.box(box.centre, turned, 0.0).reach(face)
    middle = box.centre + (box.reach(face) + gap + reach_m) * face
    return PlaceTarget(middle=middle, yaw_rad=yaw, beside=one)


def descents_of(
    target: PlaceTarget,
    held: HeldObject,
    others: Sequence[LocatedObject],
    table_m: float,
    present_yaw_rad: float,
    hand: HandOptions,
    width_m: float,
) -> list[Descent]:
    """Possible releases, those with the smallest turn of the hand first.

    Args:
        target: where.
        held: what the hand holds.
        others: all other objects.
        table_m: height of the table.
        present_yaw_rad: of the hand.
        hand: measures.
        width_m: between the fingers now.

    Raises:
        RefusedError: rule `occupied`, `unstable` or `too_close`, with the distance.
    """
    boxes = [UprightBox.of(one) for one in others]
    found = [
        _descent(target, yaw, held, boxes, table_m, hand, width_m)
        for yaw in _yaws(target, held, present_yaw_rad)
    ]
    free = [descent for descent, _ in found if descent.clearance_m >= _CLEAR_M]
    if not free:
        best, name = max(found, key=lambda pair: pair[0].clearance_m)
        raise RefusedError(
            f"The fingers would be {best.clearance_m * 1000:.1f} mm from {name} when they let go, "
            f"at least {_CLEAR_M * 1000:.0f} are needed.",
            hint="Choose another side, a larger gap or another place.",
            rule="too_close",
        )
    return sorted(free, key=lambda one: abs(_turn(present_yaw_rad, one.yaw_rad)))


def _yaws(target: PlaceTarget, held: HeldObject, present_yaw_rad: float) -> Iterator[float]:
    """Yaws of the hand that put it at the yaw of the target, by its symmetry."""
    if target.yaw_rad is None or (held.turn_rad is None and not target.is_hand_yaw):
        yield present_yaw_rad
        return
    if target.is_hand_yaw:
        yield target.yaw_rad
        return
    assert held.turn_rad is not None
    step = held.object.symmetry_rad or 2 * np.pi
    for number in range(round(2 * np.pi / step)):
        yield _turn(0.0, target.yaw_rad - held.turn_rad + number * step)


def _descent(
    target: PlaceTarget,
    yaw_rad: float,
    held: HeldObject,
    boxes: Sequence[UprightBox],
    table_m: float,
    hand: HandOptions,
    width_m: float,
) -> tuple[Descent, str]:
    """One release, and the nearest other object. Raises RefusedError."""
    footprint = held.box(target.middle, yaw_rad, table_m)
    below = [box for box in boxes if gap_m(box, footprint) < 0]
    bottom_m = table_m
    if target.on is not None:
        carrier = UprightBox.of(target.on)
        _check_carries(carrier, below, footprint)
        bottom_m = carrier.top_m
    elif below:
        raise RefusedError(
            f"There stands {below[0].name}: the two would overlap by "
            f"{-gap_m(below[0], footprint) * 1000:.0f} mm.",
            hint="Give `on` to stack it, or another place.",
            rule="occupied",
        )
    put = held.box(target.middle, yaw_rad, bottom_m + _RELEASE_M)
    apart_m, near = nearest_obstacle((put,), boxes)
    if apart_m < _APART_M:
        raise RefusedError(
            f"It would stand {apart_m * 1000:.0f} mm from {near}, at least "
            f"{_APART_M * 1000:.0f} are needed.",
            hint="Choose a larger gap or another place.",
            rule="too_close",
        )
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    tcp = target.middle - np.array([[c, -s], [s, c]]) @ held.offset_m
    position = np.array([*tcp, bottom_m + held.below_m + _RELEASE_M])
    for open_m in (hand.gap_m, min(hand.gap_m, width_m + 2 * _PLAY_M)):
        clearance_m, name = nearest_obstacle(parts_of_hand(position, yaw_rad, open_m, hand), boxes)
        if clearance_m >= _CLEAR_M:
            break
    descent = Descent(
        position_m=position,
        yaw_rad=yaw_rad,
        opening=open_m / hand.gap_m,
        object_m=np.array([*target.middle, bottom_m + float(held.object.size_m[2]) / 2]),
        clearance_m=clearance_m,
    )
    return descent, name


def _check_carries(carrier: UprightBox, below: Sequence[UprightBox], put: UprightBox) -> None:
    """Raise RefusedError if something else is on or over it, or too little of it carries."""
    higher = [box for box in below if box.top_m > carrier.top_m + 0.005]
    if higher:
        raise RefusedError(
            f"On {carrier.name} stands {higher[0].name} already.",
            hint=f"Place it on {higher[0].name}, or elsewhere.",
            rule="occupied",
        )
    off = np.abs(carrier.axes @ (put.centre - carrier.centre))
    if (off > _BORNE * carrier.half).any():
        raise RefusedError(
            f"Its middle would be {float(off.max()) * 1000:.0f} mm from that of "
            f"{carrier.name}: it would fall.",
            rule="unstable",
        )


def is_put_down(held: HeldObject) -> str:
    """What is so once the hand has let go, for errors of what follows."""
    return f"{told_name(held.object)} is put down already."


def route_down(
    descent: Descent, held: HeldObject, start: Pose, others: Sequence[LocatedObject], table_m: float
) -> list[Waypoint]:
    """The route of a place whose hand is at `start`."""
    tops = [table_m, *(UprightBox.of(one).top_m for one in others)]
    over_m = max(max(tops) + held.below_m + _OVER_M, float(descent.position_m[2]) + _OVER_M)
    here = np.array(start.position_m)
    rotation = top_down(descent.yaw_rad)
    route = []
    if here[2] < over_m:
        up = np.array([*here[:2], over_m])
        route.append(Waypoint(what="the height above all objects", position_m=up, holds=True))
    travel_m = max(over_m, min(float(here[2]), over_m + 0.1))
    above = np.array([*descent.position_m[:2], travel_m])
    away_m = max(over_m, float(descent.position_m[2]) + _LEAVE_M)
    away = np.array([*descent.position_m[:2], away_m])
    return [
        *route,
        Waypoint(what="the place above", position_m=above, rotation=rotation, holds=True),
        Waypoint(
            what="the place",
            position_m=descent.position_m,
            rotation=rotation,
            opening=descent.opening,
            done=is_put_down(held),
        ),
        Waypoint(what="the height above it", position_m=away, rotation=rotation),
    ]


def target_object(looker: Looker, who: str, name: str, path: str) -> tuple[CellLook, LocatedObject]:
    """The object that a call names, or "mark N" of the client's last look.

    Raises:
        InvalidInputError, NotReadyError: as `seen_target`.
    """
    mark = name.removeprefix("mark").strip()
    if mark.isdecimal() and len(mark) < 4:
        return seen_target(looker, who, "", int(mark))
    try:
        return seen_target(looker, who, name, None)
    except InvalidInputError as error:
        error.path = path
        raise


def _turn(start_rad: float, end_rad: float) -> float:
    return float((end_rad - start_rad + np.pi) % (2 * np.pi) - np.pi)
