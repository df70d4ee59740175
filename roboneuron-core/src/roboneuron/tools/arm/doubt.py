"""Plans among objects that are not all seen well, and places from where they would be."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import LocatedObject
from roboneuron.errors import RefusedError
from roboneuron.server.tool import CallContext
from roboneuron.sight.looker import Looker
from roboneuron.sight.marks import CellLook, told_name
from roboneuron.sight.sightlines import is_covered, is_seen_well
from roboneuron.supervisor.changes import Stage
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.routes import RobotCarrier, Waypoint, rehearse, run_route

T = TypeVar("T")
_LOOKS = 2
"""Places from which is looked again."""
UNCLEAR = "unclear"
"""Rule of a refusal because something is not seen well enough to judge it."""
_ASIDE_M = ((0.0, 0.0, 0.12), (0.0, 0.15, 0.08), (0.0, -0.15, 0.08), (-0.12, 0.0, 0.12))
"""Displacements of the hand, so that it hides something else."""


class UnclearError(RefusedError):
    """An object is not seen well enough to judge the plan; nothing has moved.

    Attributes:
        place_m: about where it is (3,).
    """

    def __init__(self, name: str, uncertainty_m: float, place_m: F64) -> None:
        """Describe an object: its quoted name, the uncertainty [m] of its place, that (3,)."""
        self.place_m = place_m
        super().__init__(
            f"{name} is partly hidden, and was not seen well before: its place is known only "
            f"to {uncertainty_m * 1000:.0f} mm.",
            hint="Move the hand away with move_ee, up or aside, so that the cameras see it; then "
            "call again.",
            rule=UNCLEAR,
        )


def check_seen_well(one: LocatedObject) -> None:
    """Raise UnclearError for a target whose place is not known well."""
    if not is_seen_well(one):
        raise UnclearError(told_name(one), one.uncertainty_m, one.position_m)


def judged(plan: Callable[[Sequence[LocatedObject]], T], others: Sequence[LocatedObject]) -> T:
    """A plan among other objects.

    Raises:
        UnclearError: it is refused only because of one that is not seen well.
        RefusedError: as `plan`.
    """
    try:
        return plan(others)
    except RefusedError:
        certain = [one for one in others if is_seen_well(one)]
        if len(certain) == len(others):
            raise
        plan(certain)  # what is refused also without them is refused with that reason
        vague = max(others, key=lambda one: one.uncertainty_m)
        raise UnclearError(told_name(vague), vague.uncertainty_m, vague.position_m) from None


async def planned(
    plan: Callable[[Stage], T],
    looker: Looker,
    mover: EndEffectorMover,
    arm: str,
    context: CallContext,
    *,
    holds: bool = False,
) -> T:
    """Make a plan; where something is hidden, move the hand aside, look again, and plan anew.

    Args:
        plan: looks and plans; on a worker thread.
        looker, mover, arm: that look, and move the hand of that arm.
        context: of the call.
        holds: the hand must not lose what it holds.

    Raises:
        UnclearError: it is hidden from there too.
        RoboNeuronError: as `plan`, and as the motion.
    """
    try:
        return await context.run(plan)
    except UnclearError as error:
        unclear = error
    look = looker.last_look(context.who)
    here = await context.run(lambda _: mover.pose())
    aside = lookouts(look, arm, here.position_m, unclear.place_m) if look is not None else ()
    for place in list(aside)[:_LOOKS]:
        route = [Waypoint(what="a place to look from", position_m=place, holds=holds)]
        try:
            await context.run(partial(_rehearsed, mover, route))
        except RefusedError:
            continue
        await run_route(RobotCarrier(mover, context), route, 1.0, mover.fastest)
        try:
            return await context.run(plan)
        except UnclearError as error:
            unclear = error
    raise unclear


def _rehearsed(mover: EndEffectorMover, route: Sequence[Waypoint], _: Stage) -> None:
    rehearse(mover, route, 1.0)


def lookouts(look: CellLook, arm: str, tcp_m: F64, place_m: F64) -> Iterator[F64]:
    """Places of the TCP (3,) near `tcp_m` (3,), from where the hand does not hide a place (3,) from
    all cameras: those first that leave it to most cameras.
    """
    free = []
    for number, aside in enumerate(_ASIDE_M):
        at = tcp_m + np.array(aside)
        hands = dict(look.hands)
        if arm in hands:
            hands[arm] = hands[arm].moved_to(at)
        seen_by = sum(not is_covered(place_m, image, hands) for image in look.view.images)
        free.append((-seen_by, number, at))
    for _, _, at in sorted(free, key=lambda item: item[:2]):
        yield at
