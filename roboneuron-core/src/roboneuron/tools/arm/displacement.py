"""Objects that a motion has displaced, from the looks before and after it."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from pydantic import Field

from roboneuron.contract.locator import LocatedObject
from roboneuron.errors import RefusedError, RoboNeuronError
from roboneuron.server.host import Host
from roboneuron.server.tool import Picture, Result
from roboneuron.sight.looker import looker_of
from roboneuron.sight.marks import CellLook, look_pictures, name_of, nearest_like, told_name
from roboneuron.sight.sightlines import is_covered

__all__ = ["SceneWatch"]
"""Names that other distributions may use."""

MOVED_M, FOLLOW_M = 0.003, 0.15
"""Least displacement of another object that is told, and the largest that is recognised."""

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


class MovedObject(Result):
    """Another object that is elsewhere than before."""

    object: str
    by_m: float


class Surroundings(Result):
    """What an answer says of a motion beside its object: the speed, and other objects."""

    max_tcp_speed_m_s: float | None = Field(default=None, description="highest, as measured")

    others_moved: list[MovedObject] | None = Field(
        default=[], description="null: none is known to have moved, and not all were seen well"
    )
    not_seen_well: list[str] = Field(
        default=[], description="hidden before or after: whether they moved is not known"
    )
    not_seen_after: list[str] = Field(default=[])


def displaced(before: CellLook, after: CellLook, carried: LocatedObject | None) -> Surroundings:
    """Other objects that are elsewhere than before, as far as both looks tell."""
    moved: list[MovedObject] = []
    told = Surroundings(others_moved=moved, not_seen_well=[], not_seen_after=[])
    left = list(after.objects)
    if carried is not None:
        held = nearest_like(left, carried, np.inf)
        alike = [one for one in before.objects if name_of(one) == name_of(carried)]
        if held is not None and len(alike) <= 1:
            left.remove(held)
    for one in before.objects:
        if one is carried or one in before.held.values():
            continue
        again = nearest_like(left, one, FOLLOW_M)
        if again is None:
            told.not_seen_after.append(name_of(one))
            continue
        left.remove(again)
        by_m = float(np.linalg.norm(again.position_m - one.position_m))
        doubt_m = one.uncertainty_m + again.uncertainty_m
        is_certain = before.is_certain(one) and after.is_certain(again)
        if again.is_height_assumed and not one.is_height_assumed:
            # fewer cameras see it than before: the outline that is left may be cut
            is_certain = is_certain and not _may_be_cut(again, after)
        if is_certain and by_m > max(MOVED_M, doubt_m):
            moved.append(MovedObject(object=name_of(one), by_m=round(by_m, 4)))
        elif by_m > MOVED_M or not is_certain:
            told.not_seen_well.append(name_of(one))
    is_open = told.not_seen_well or told.not_seen_after
    return told.model_copy(update={"others_moved": moved or (None if is_open else [])})


def _may_be_cut(one: LocatedObject, look: CellLook) -> bool:
    """True if an arm or another object may cover a part of an object for a camera that sees it."""
    others = [other for other in look.objects if other is not one]
    parts = one.position_m + np.stack([np.zeros(3), *(_CORNERS * one.size_m / 2)])
    return any(
        is_covered(part, image, look.hands, others)
        for image in look.view.images
        if image.frame.camera in one.cameras
        for part in parts
    )


class SceneWatch:
    """The objects around one motion that a policy makes; used from one thread.

    Args:
        host: the server.
        instruction: names the object that is to move, by its colour.
        who: the client, whose marks become those of the last look.
    """

    def __init__(self, host: Host, instruction: str, who: str) -> None:
        self._host, self._who = host, who
        self._words = instruction.lower()
        self._before: CellLook | None = None
        self._after: CellLook | None = None

    def look_before(self) -> None:
        """Look at the scene; blocks for at most a second."""
        self._before = self._look(0)

    def check_hands(self) -> None:
        """Raise RefusedError if every hand is seen to hold something else than the object that the
        instruction names first: to grasp that one, a policy would let go of it wherever it is.
        """
        look = self._before
        meant = None if look is None else self._meant(look)
        if look is None or meant is None or meant in look.held.values():
            return
        if look.held and look.held.keys() == look.hands.keys():
            raise RefusedError(
                f"The hand holds {' and '.join(map(told_name, look.held.values()))} already.",
                hint="Call place first.",
                rule="full_hand",
            )

    def moved(self) -> dict[str, float] | None:
        """How far other objects have moved since [m], by name; None if it was not seen. Blocks for
        at most a second.
        """
        before = self._before
        after = self._after = None if before is None else self._look(time.time_ns())
        if before is None or after is None:
            return None
        others = displaced(before, after, self._meant(before)).others_moved
        return None if others is None else {other.object: other.by_m for other in others}

    def pictures(self, cameras: Sequence[str]) -> tuple[list[Picture], list[Picture]] | None:
        """Pictures of these cameras from before and after, with the names of the objects; None
        without both looks.
        """
        if self._before is None or self._after is None:
            return None
        return (
            look_pictures(self._before, caption="before", cameras=cameras),
            look_pictures(self._after, caption="after", cameras=cameras),
        )

    def _look(self, newer_than_ns: int) -> CellLook | None:
        if self._host.clock(self._host.config.namespace).stands:
            return None
        try:
            look = looker_of(self._host).look(self._who, newer_than_ns)
        except RoboNeuronError:
            return None
        return look if look.view.images and not look.failure else None

    def _meant(self, look: CellLook) -> LocatedObject | None:
        """The object whose colour the instruction names first."""
        named = [
            (place, number)
            for number, one in enumerate(look.objects)
            if one.colour and (place := self._words.find(one.colour.lower())) >= 0
        ]
        return look.objects[min(named)[1]] if named else None
