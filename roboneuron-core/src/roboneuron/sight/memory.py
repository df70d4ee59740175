"""Last good sightings of objects, used while the arm or what it holds hides them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboneuron.contract.locator import CalibratedImage, LocatedObject
from roboneuron.sight.cell_view import CellView
from roboneuron.sight.marks import name_of
from roboneuron.sight.sightlines import (
    GOOD_M,
    HandSight,
    is_covered,
    is_seen_well,
    may_be_at,
    nearest_on_line,
)

_KEPT_S = 600.0
IN_HAND_M = 0.06
"""Distance from the TCP within which an object is the one that the hand holds."""
_ON_LINE_M = 0.035
"""Likewise, of the TCP from a line of sight: nobody sees through a hand."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Recalled:
    """What is seen, completed by what was seen before.

    Attributes:
        objects: all of them.
        hidden: those of `objects` that are hidden or seen badly now: as they were last seen well.
        held: the object in each hand that is seen there, by the hand.
    """

    objects: tuple[LocatedObject, ...]
    hidden: frozenset[LocatedObject] = frozenset()
    held: Mapping[str, LocatedObject]


class SightMemory:
    """Keeps the last good sighting of each object that nobody has touched since; used from one
    thread at a time.
    """

    def __init__(self) -> None:
        self._known: list[LocatedObject] = []

    def clear(self) -> None:
        """Forget everything: the table may have changed."""
        self._known.clear()

    def forget(self, one: LocatedObject) -> None:
        """Forget an object that is moved now."""
        self._known = [other for other in self._known if name_of(other) != name_of(one)]

    def recall(
        self, view: CellView, found: Iterable[LocatedObject], hands: Mapping[str, HandSight]
    ) -> Recalled:
        """Complete what a locator found in the pictures of a view; without pictures it is nothing.

        Args:
            view: the pictures.
            found: objects in them.
            hands: by the name of the arm.
        """
        rest = list(found)
        if not view.images:
            return Recalled(objects=tuple(rest), held={})
        held = {
            arm: one
            for arm, hand in hands.items()
            if hand.holding and (one := _take_held(rest, hand, view.images)) is not None
        }
        for one in (*held.values(), *(hand.known for hand in hands.values() if hand.known)):
            self.forget(one)
        known = [one for one in self._known if _age_s(one, view) <= _KEPT_S]
        clear, hidden = [], []
        for one in sorted(rest, key=lambda seen: not is_seen_well(seen)):
            before = _claimed(known, one)
            if before is not None and _is_told_better(before, one, view.images):
                hidden.append(before)
            else:
                clear.append(_with_doubt(one, view.images, hands))
        seen = [*clear, *hidden]
        for one in known:
            if _may_be_hidden(one, view.images, hands, seen):
                hidden.append(one)
        self._known = [*(one for one in clear if is_seen_well(one)), *hidden]
        return Recalled(
            objects=(*held.values(), *clear, *hidden), hidden=frozenset(hidden), held=held
        )


def _age_s(one: LocatedObject, view: CellView) -> float:
    return (view.taken_ns - one.seen_at_ns) / 1e9


def _claimed(known: list[LocatedObject], one: LocatedObject) -> LocatedObject | None:
    """Take out the sighting of that name that is nearest to an object."""
    alike = [
        (float(np.linalg.norm(was.position_m - one.position_m)), number)
        for number, was in enumerate(known)
        if name_of(was) == name_of(one)
    ]
    return known.pop(min(alike)[1]) if alike else None


def _is_told_better(
    before: LocatedObject, now: LocatedObject, images: Sequence[CalibratedImage]
) -> bool:
    """True if an earlier sighting tells the place of an object better than the present one, which
    does not contradict it.
    """
    is_lower = now.is_height_assumed and before.position_m[2] - now.position_m[2] > GOOD_M
    return (is_lower or not is_seen_well(now)) and may_be_at(now, before.position_m, images)


def _with_doubt(
    one: LocatedObject, images: Sequence[CalibratedImage], hands: Mapping[str, HandSight]
) -> LocatedObject:
    """An object that one camera sees past an arm, which may hide a part of its outline: its middle
    may be a quarter of its size elsewhere.
    """
    shown = [image for image in images if image.frame.camera in one.cameras]
    if len(shown) != 1 or not is_covered(one.position_m, shown[0], hands):
        return one
    doubt_m = max(one.uncertainty_m, float(one.size_m.min()) / 4)
    return replace(one, uncertainty_m=doubt_m)


def _take_held(
    rest: list[LocatedObject], hand: HandSight, images: Sequence[CalibratedImage]
) -> LocatedObject | None:
    """Take out the object that a hand holds, placed there; None if none is seen there."""
    place = hand.position_m if hand.known is None else hand.known.position_m
    near = []
    for number, one in enumerate(rest):
        if hand.known is not None and name_of(one) != name_of(hand.known):
            continue
        apart_m, at = float(np.linalg.norm(one.position_m - place)), one.position_m
        passing = nearest_on_line(one, place, images)
        is_elsewhere = is_seen_well(one) and not one.is_height_assumed
        if apart_m >= IN_HAND_M and passing is not None and not is_elsewhere:
            apart_m, at = passing
            apart_m *= IN_HAND_M / _ON_LINE_M
        if apart_m < IN_HAND_M:
            near.append((apart_m, number, at))
    if not near:
        return None
    _, number, at = min(near, key=lambda item: item[0])
    one = rest.pop(number)
    if at is one.position_m:
        return one
    if hand.known is not None:
        return replace(hand.known, cameras=one.cameras, seen_at_ns=one.seen_at_ns)
    return replace(
        one,
        position_m=at,
        yaw_rad=None,
        uncertainty_m=max(_ON_LINE_M, one.uncertainty_m),
        is_whole=False,
        is_height_assumed=False,
    )


def _may_be_hidden(
    one: LocatedObject,
    images: Sequence[CalibratedImage],
    hands: Mapping[str, HandSight],
    others: Sequence[LocatedObject],
) -> bool:
    """True if no picture shows the place of an object without something before it."""
    return all(
        not _is_inside(one, image) or is_covered(one.position_m, image, hands, others)
        for image in images
    )


def _is_inside(one: LocatedObject, image: CalibratedImage) -> bool:
    column, row = image.view.project(one.position_m).tolist()
    height, width = image.frame.image.shape[:2]
    return bool(0 <= column < width and 0 <= row < height)  # false for NaN
