"""Tool place: put down the held object next to its present place, in one call."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from rn_standard.sight.looker import looker_of
from rn_standard.sight.marks import name_of, nearest_like
from rn_standard.tools_arm.displacement import FOLLOW_M, MovedObject, displaced
from rn_standard.tools_arm.ee_move import EndEffectorMove, MoveEndEffector
from rn_standard.tools_arm.end_effector import EndEffectorMover
from rn_standard.tools_arm.grip_height import GripHeight
from rn_standard.tools_arm.options import HandOptions
from rn_standard.tools_arm.place_plans import PlaceArguments, PlacePlan, plan_place
from rn_standard.tools_arm.routes import RobotCarrier, now_ns, run_route
from rn_standard.tools_arm.several_arms import arguments_of, handler_of
from roboneuron import (
    CallContext,
    Host,
    InvalidInputError,
    Pose,
    RefusedError,
    Result,
    StateError,
    Tool,
)

_CLEAR_M = 0.08
"""Height to which the held object is lifted above its place, to clear objects on the table."""
_GAP_M = 0.002
"""Height of the release above that of the grasp: the object is dropped slightly rather than pressed
into the table.
"""
_NEAR_M = 0.003
_LONGEST_M = 0.5


class Placed(Result):
    """The released object and its place."""

    robot: str
    arm: str = Field(default="", description="which of several arms")
    released_at_m: list[float] = Field(description="TCP when the hand opened, base frame")
    moved: dict[str, float] = Field(description="from where the hand was at the call")
    holding: bool | None = Field(description="the hand still holds something; null: unknown")
    took_s: float
    object: str = ""
    placed_at_m: list[float] = Field(default=[], description="its middle as seen afterwards")
    others_moved: list[MovedObject] = Field(default=[])
    not_seen_after: list[str] = Field(default=[])


@dataclass(frozen=True, kw_only=True, slots=True)
class PlaceRoute:
    """The moves of one call.

    Attributes:
        carry: with the object in the hand.
        release: opens the hand.
        leave: with the hand open.
    """

    carry: tuple[MoveEndEffector, ...]
    release: MoveEndEffector
    leave: tuple[MoveEndEffector, ...]


class Placer:
    """Moves with move_ee, which keeps the grip, and detects a lost object.

    Attributes:
        mover, grip: of the arm.
    """

    def __init__(
        self,
        mover: EndEffectorMover,
        grip: GripHeight,
        host: Host | None = None,
        hand: HandOptions | None = None,
    ) -> None:
        """Args:
        mover, grip: of the arm.
        host: to look at the cell; without it only relative places are possible.
        hand: measures.
        """
        self.mover = mover
        self.grip = grip
        self._host = host
        self._hand = hand or HandOptions()

    async def __call__(self, arguments: PlaceArguments, context: CallContext) -> Placed:
        """Lift, carry, lower, release, and retract upwards.

        Raises:
            RefusedError: the hand holds nothing, or as move_ee.
            InvalidInputError: the height of the release is unknown.
            StateError: the hand lost the object on the way.
        """
        began_s = time.monotonic()
        self.mover.check()
        await context.run(lambda _: self.check_holds())
        plan = await context.run(lambda _: self.plan(arguments, context.who))
        if plan is not None:
            return await self._put_down(plan, arguments, context, began_s)
        self.release_height_m(arguments)
        start = await context.run(lambda _: self.mover.pose())
        route = self.route(arguments, start)
        for move in route.carry:
            moved = await self.mover(move, context)
            _check(moved)
            if moved.holding is False:  # also what was lost between two moves
                raise StateError(
                    f"The hand has lost what it held, at {moved.position_m} m or before."
                )
        opened = await self.mover(route.release, context)
        for move in route.leave:
            _check(await self.mover(move, context))
        place, here = opened.position_m, start.position_m
        return Placed(
            robot=opened.robot,
            arm=opened.arm,
            released_at_m=place,
            moved={"dx_m": round(place[0] - here[0], 4), "dy_m": round(place[1] - here[1], 4)},
            holding=opened.holding,
            took_s=round(time.monotonic() - began_s, 3),
        )

    def plan(
        self, arguments: PlaceArguments, who: str, start: Pose | None = None
    ) -> PlacePlan | None:
        """See `plan_place`."""
        return plan_place(self._host, self.mover, self.grip, self._hand, arguments, who, start)

    async def _put_down(
        self, plan: PlacePlan, arguments: PlaceArguments, context: CallContext, began_s: float
    ) -> Placed:
        assert self._host is not None
        carrier = RobotCarrier(self.mover, context)
        await run_route(carrier, plan.route, arguments.speed, self.mover.fastest)
        looker, since_ns = looker_of(self._host), now_ns()
        after = await context.run(lambda _: looker.look(context.who, since_ns))
        name = name_of(plan.held.object)
        meant = replace(plan.held.object, position_m=plan.descent.object_m)
        seen = nearest_like(after.objects, meant, FOLLOW_M)
        moved, lost = displaced(plan.look, after, plan.held.object)
        place, here = plan.descent.position_m, plan.start.position_m
        return Placed(
            robot=self.mover.robot,
            arm=self.grip.arm,
            released_at_m=np.round(place, 4).tolist(),
            moved={
                "dx_m": round(float(place[0] - here[0]), 4),
                "dy_m": round(float(place[1] - here[1]), 4),
            },
            holding=await context.run(lambda _: self.grip.holding()),
            took_s=round(time.monotonic() - began_s, 3),
            object=name,
            placed_at_m=[] if seen is None else np.round(seen.position_m, 4).tolist(),
            others_moved=moved,
            not_seen_after=[one for one in lost if one != name],
        )

    def check_holds(self) -> None:
        """Raise RefusedError for an empty hand, or none; waits until the fingers rest."""
        self.grip.check_fitted()
        if self.grip.holding() is False:
            raise RefusedError(
                "The hand holds nothing that could be put down.",
                hint="See get_status, robot.",
                rule="empty_hand",
            )

    def release_height_m(self, arguments: PlaceArguments) -> float:
        """Height of the TCP at the release. Raises InvalidInputError if it is unknown."""
        if arguments.height_m is not None:
            return arguments.height_m
        height_m = self.grip.closed_at_m
        if height_m is None:
            raise InvalidInputError(
                "It is not known how high the hand was when it closed.",
                hint="Give height_m: the height of the TCP at which to let go.",
                path="height_m",
            )
        return height_m + _GAP_M

    def route(self, arguments: PlaceArguments, start: Pose) -> PlaceRoute:
        """The moves of a call that begins with the TCP at `start`. Raises as `release_height_m`."""
        release_m = self.release_height_m(arguments)
        height_m = float(start.position_m[2])
        carry_m = max(height_m, release_m + _CLEAR_M)
        return PlaceRoute(
            carry=(
                *_pieces(dz_m=carry_m - height_m),
                *_pieces(dx_m=arguments.dx_m, dy_m=arguments.dy_m),
                *_pieces(dz_m=release_m - carry_m),
            ),
            release=MoveEndEffector(gripper_open=1.0),
            leave=tuple(_pieces(dz_m=_CLEAR_M)),
        )


def _pieces(**delta: float) -> Iterator[MoveEndEffector]:
    """One straight part, in pieces that move_ee accepts."""
    longest = max(abs(value) for value in delta.values())
    if longest < _NEAR_M:
        return
    count = int(longest / _LONGEST_M - 1e-9) + 1
    for _ in range(count):
        yield MoveEndEffector.model_validate({name: value / count for name, value in delta.items()})


def _check(moved: EndEffectorMove) -> None:
    """Raise RefusedError if nothing was moved."""
    if moved.simulated or not moved.allowed:
        raise RefusedError(
            f"The arm was not moved: {moved.reason or 'only simulated'}.", rule="simulate"
        )


def place_tool(
    host: Host,
    movers: Mapping[str, EndEffectorMover],
    grips: Mapping[str, GripHeight],
    hand: HandOptions,
    robot: str,
) -> Tool[PlaceArguments]:
    """Create place for the arms that have a gripper.

    Args:
        host: of the feature.
        movers: by arm, those without a gripper included.
        grips: by arm, for those with a gripper.
        hand: measures.
        robot: name of the robot.
    """
    placers = {arm: Placer(movers[arm], grip, host, hand) for arm, grip in grips.items()}
    return Tool(
        name="place",
        title="Put down what the hand holds",
        description=f"Put down what {robot!r} holds: shifted by dx_m, dy_m, at a position, on an "
        "object or beside one. Looks before and after, unless a policy grasped it and the call "
        "shifts it: that lowers to where it was grasped, whatever stands there.",
        arguments=arguments_of(PlaceArguments, placers),
        result=Placed,
        handler=handler_of(placers),
        simulated_by=frozenset({"twin"}),
        open_world=True,
    )
