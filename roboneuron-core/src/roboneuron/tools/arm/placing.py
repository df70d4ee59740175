"""Tool place: put down the held object next to its present place, in one call."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from roboneuron.contract import F64, Pose
from roboneuron.contract.locator import LocatedObject
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import InvalidInputError, RefusedError, RoboNeuronError, StateError
from roboneuron.server.host import Host
from roboneuron.server.rehearsal import Needs, Rehearsal
from roboneuron.server.tool import CallContext, Tool
from roboneuron.sight.looker import looker_of
from roboneuron.sight.marks import CellLook, name_of, nearest_like, told_name
from roboneuron.sight.memory import IN_HAND_M
from roboneuron.sight.sightlines import is_seen_well
from roboneuron.supervisor.changes import Stage
from roboneuron.tools.arm.absolute import slowed, yaw_of
from roboneuron.tools.arm.bounds import check_route
from roboneuron.tools.arm.displacement import FOLLOW_M, Surroundings, displaced
from roboneuron.tools.arm.doubt import UnclearError, planned
from roboneuron.tools.arm.ee_move import EndEffectorMove, MoveEndEffector
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.grip_height import GripHeight
from roboneuron.tools.arm.hand_space import UprightBox, gap_m
from roboneuron.tools.arm.landing import MissedError, landed
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.place_plans import PlaceArguments, PlacePlan, plan_place
from roboneuron.tools.arm.put_down import is_put_down
from roboneuron.tools.arm.routes import RobotCarrier, Waypoint, carry_out_in_twin, now_ns, run_route
from roboneuron.tools.arm.several_arms import arguments_of, handler_of

_CLEAR_M = 0.08
"""Height to which the held object is lifted above its place, to clear objects on the table."""
_GAP_M = 0.002
"""Height of the release above that of the grasp: the object is dropped slightly rather than pressed
into the table.
"""
_NEAR_M = 0.003
_UNDER_M = 0.01
"""Height below the TCP that what the hand holds takes at least."""
_LONGEST_M = 0.5


class Placed(Surroundings):
    """The released object and its place."""

    robot: str
    arm: str = Field(default="", description="which of several arms")
    released_at_m: list[float] = Field(description="TCP when the hand opened, base frame")
    moved: dict[str, float] = Field(
        description="the object, from where pick saw it; else the hand, since the call"
    )
    holding: bool | None = Field(description="the hand still holds something; null: unknown")
    took_s: float
    object: str = ""
    placed_at_m: list[float] = Field(
        default=[], description="its middle as seen afterwards; empty: not seen well"
    )
    error_m: float | None = Field(default=None, description="of it from where it was to be")
    gap_m: float | None = Field(default=None, description="between it and the one it is beside")


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
    """Moves with move_ee, which keeps the grip, and detects a lost object. Follows
    `Rehearsable`.
    """

    rehearsal_needs: Needs = frozenset({"control", "scene"})

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
            MissedError: it lies elsewhere than asked for.
        """
        began_s = time.monotonic()
        self.mover.check()
        await context.run(lambda _: self.check_holds())
        plan = await self._planned(arguments, context)
        if plan is not None:
            return await self._put_down(plan, arguments, context, began_s)
        self.release_height_m(arguments)
        start = await context.run(lambda _: self.mover.pose())
        await context.run(lambda _: self.check_free(arguments, start, context.who))
        route = self.route(arguments, start)
        await context.run(lambda _: self._check_route(route, start))
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

    def rehearse(self, arguments: PlaceArguments, rehearsal: Rehearsal) -> None:
        """See `Rehearsable`: the twin's hand may lose what it holds as the robot's may."""
        mover, arm = self.mover, rehearsal.arm
        self.check_holds()
        start = mover.pose_of(arm)
        plan = self.plan(arguments, rehearsal.context.who, start)
        if plan is not None:
            carry_out_in_twin(mover, self.grip, rehearsal, plan.route, arguments.speed)
            return
        route = self.route(arguments, start)
        for move in route.carry:
            mover.rehearse(move, rehearsal)
            if not self.grip.would_hold(arm.joints(), self.grip.kept()):
                raise StateError("The hand loses what it holds on the way.")
        mover.rehearse(route.release, rehearsal)
        opening = route.release.gripper_open
        for move in route.leave:
            mover.rehearse(move.model_copy(update={"gripper_open": opening}), rehearsal)

    def plan(
        self, arguments: PlaceArguments, who: str, start: Pose | None = None
    ) -> PlacePlan | None:
        """See `plan_place`."""
        return plan_place(self._host, self.mover, self.grip, self._hand, arguments, who, start)

    async def _planned(self, arguments: PlaceArguments, context: CallContext) -> PlacePlan | None:
        if self._host is None:
            return await context.run(lambda _: self.plan(arguments, context.who))
        return await planned(
            lambda _: self.plan(arguments, context.who),
            looker_of(self._host),
            self.mover,
            self.grip.arm,
            context,
            holds=True,
        )

    async def _put_down(
        self, plan: PlacePlan, arguments: PlaceArguments, context: CallContext, began_s: float
    ) -> Placed:
        assert self._host is not None
        carrier = RobotCarrier(self.mover, context)
        await run_route(carrier, plan.route, arguments.speed, self.mover.fastest)
        try:
            after, seen = await self._after(plan, context)
        except MissedError:
            raise
        except RoboNeuronError as error:
            raise error.with_hint(is_put_down(plan.held)) from error
        return self._told(plan, after, seen).model_copy(
            update={
                "holding": await context.run(lambda _: self.grip.holding()),
                "max_tcp_speed_m_s": carrier.highest_m_s,
                "took_s": round(time.monotonic() - began_s, 3),
            }
        )

    async def _after(
        self, plan: PlacePlan, context: CallContext
    ) -> tuple[CellLook, LocatedObject | None]:
        """A look, and the object in it; from aside if it is not seen well. Raises MissedError."""
        assert self._host is not None
        looker = looker_of(self._host)
        one, meant_m = plan.held.object, plan.descent.object_m

        def look_at_it(_: Stage) -> tuple[CellLook, LocatedObject | None]:
            after = looker.look(context.who, now_ns())
            seen = landed(plan.look, after, one, meant_m)
            if seen is None:
                raise UnclearError(told_name(one), float(one.size_m[0]), meant_m)
            return after, seen

        try:
            return await planned(look_at_it, looker, self.mover, self.grip.arm, context)
        except UnclearError:
            after = looker.last_look(context.who)
            return plan.look if after is None else after, None

    def _told(self, plan: PlacePlan, after: CellLook, seen: LocatedObject | None) -> Placed:
        place, was = plan.descent.position_m, plan.held.object.position_m
        shift = None if seen is None else seen.position_m - was
        if shift is None or not plan.held.is_origin_known:
            shift = place - plan.start.position_m
        near = None if plan.target is None else nearest_like(after.objects, plan.target, FOLLOW_M)
        between_m = None
        if seen is not None and near is not None:
            between_m = round(gap_m(UprightBox.of(seen), UprightBox.of(near)), 4)
        off_m = (
            None if seen is None else float(np.linalg.norm(seen.position_m - plan.descent.object_m))
        )
        return Placed(
            robot=self.mover.robot,
            arm=self.grip.arm,
            released_at_m=np.round(place, 4).tolist(),
            moved={"dx_m": round(float(shift[0]), 4), "dy_m": round(float(shift[1]), 4)},
            holding=None,
            took_s=0.0,
            object=name_of(plan.held.object),
            placed_at_m=[] if seen is None else np.round(seen.position_m, 4).tolist(),
            error_m=None if off_m is None else round(off_m, 4),
            gap_m=between_m,
            **displaced(plan.look, after, plan.held.object).model_dump(),
        )

    def check_holds(self) -> None:
        """Raise RefusedError for an empty hand, or none; waits until the fingers rest."""
        self.grip.check_fitted()
        if self.grip.holding() is False:
            raise RefusedError(
                "The hand holds nothing that could be put down.",
                hint="Call pick first; get_status, robot, tells the opening.",
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

    def check_free(self, arguments: PlaceArguments, start: Pose, who: str) -> None:
        """Look, and check that nothing stands where a relative place lowers what the hand holds,
        taken to be as wide as the fingers are apart. Does nothing where nothing can be seen.

        Raises:
            RefusedError: something stands there.
        """
        if self._host is None:
            return
        try:
            look = looker_of(self._host).look(who)
            width_m = self.grip.measured() * self._hand.gap_m
        except RoboNeuronError:
            return
        release_m = self.release_height_m(arguments)
        put = UprightBox(
            centre=start.position_m[:2] + np.array([arguments.dx_m, arguments.dy_m]),
            half=np.full(2, width_m / 2),
            yaw_rad=yaw_of(matrix_from_quaternion(start.quaternion_xyzw)),
            bottom_m=release_m - _UNDER_M,
            top_m=release_m,
        )
        for one in look.objects:
            box = UprightBox.of(one)
            is_held = float(np.linalg.norm(one.position_m - start.position_m)) < IN_HAND_M
            if is_held or not is_seen_well(one) or box.top_m <= put.bottom_m:
                continue
            if gap_m(put, box) < 0:
                raise RefusedError(
                    f"Where it would be lowered stands {box.name}.",
                    hint="Give another dx_m, dy_m, or `on` to stack it.",
                    rule="occupied",
                )

    def _check_route(self, route: PlaceRoute, start: Pose) -> None:
        """Raise RefusedError unless the arm would get to the end of the moves."""
        if self._host is None:
            return
        place, points = np.array(start.position_m), list[Waypoint]()
        for what, moves in (("the way to the place", route.carry), ("the retreat", route.leave)):
            for move in moves:
                place = place + move.delta()[:3]
                points.append(Waypoint(what=what, position_m=place))
        check_route(self._host, self.mover, "The place", points, 1.0)

    def route(self, arguments: PlaceArguments, start: Pose) -> PlaceRoute:
        """The moves of a call that begins with the TCP at `start`. Raises as `release_height_m`."""
        release_m = self.release_height_m(arguments)
        height_m = float(start.position_m[2])
        carry_m = max(height_m, release_m + _CLEAR_M)
        along = np.array([arguments.dx_m, arguments.dy_m, 0.0, 0.0, 0.0, 0.0])
        up = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])

        def pieces(way: F64) -> Iterator[MoveEndEffector]:
            """One straight part (6,), in pieces that move_ee accepts."""
            longest = float(np.abs(way).max())
            if longest < _NEAR_M:
                return
            count = int(longest / _LONGEST_M - 1e-9) + 1
            fields = slowed(way / count, arguments.speed, self.mover.fastest)
            for _ in range(count):
                yield MoveEndEffector.model_validate(fields)

        return PlaceRoute(
            carry=(
                *pieces((carry_m - height_m) * up),
                *pieces(along),
                *pieces((release_m - carry_m) * up),
            ),
            release=MoveEndEffector(gripper_open=1.0),
            leave=tuple(pieces(_CLEAR_M * up)),
        )


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
        "object or beside one. Looks before and after; what a policy grasped and the call shifts "
        "is lowered to the height of the grasp.",
        arguments=arguments_of(PlaceArguments, placers),
        result=Placed,
        handler=handler_of(placers),
        simulated_by=frozenset({"twin"}),
        open_world=True,
    )
