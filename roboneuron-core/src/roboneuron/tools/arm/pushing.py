"""Tool push: shift an object over the table with closed fingers, corrected by looking."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from pydantic import Field

from roboneuron.contract import Pose
from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import LocatedObject
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import InvalidInputError, RefusedError, StateError
from roboneuron.server.host import Host
from roboneuron.server.rehearsal import Needs, Rehearsal
from roboneuron.server.tool import Arguments, CallContext, Tool
from roboneuron.sight.looker import Looker, looker_of, seen_target
from roboneuron.sight.marks import CellLook, name_of, nearest_like, told_name
from roboneuron.sight.sightlines import is_seen_well
from roboneuron.supervisor.changes import Stage
from roboneuron.tools.arm.absolute import top_down, yaw_of
from roboneuron.tools.arm.bounds import check_route
from roboneuron.tools.arm.displacement import FOLLOW_M, Surroundings, displaced
from roboneuron.tools.arm.doubt import judged, planned
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.grasps import boxes_of, check_uncovered
from roboneuron.tools.arm.grip_height import GripHeight
from roboneuron.tools.arm.hand_space import UprightBox, nearest_obstacle, parts_of_hand
from roboneuron.tools.arm.options import HandOptions
from roboneuron.tools.arm.routes import RobotCarrier, Waypoint, carry_out_in_twin, now_ns, run_route
from roboneuron.tools.arm.several_arms import arguments_of, handler_of

_BACK_M, _OVER_M = 0.02, 0.05
"""Distance before contact at which the fingers come down; height over all objects of travel."""
_CLEAR_M = 0.005
_LEAST_M = 0.003
"""Shorter parts of a push are not made."""
_GOOD_M, _TRIES = 0.005, 3
_MISSED_M = 0.010
"""Beyond it and the uncertainty of the sighting, the object did not go where it was to go."""
_SPEED = 0.3
_FLOOR_M = 0.012


class PushArguments(Arguments):
    """Arguments of push."""

    arm: str = Field(default="", description="Which of several arms.")
    object: str = Field(default="", description="Name that look gives.")
    mark: int | None = Field(default=None, ge=1, description="Or a mark of your last look.")
    dx_m: float = Field(default=0.0, ge=-0.3, le=0.3, description="Along x of the base [m].")
    dy_m: float = Field(default=0.0, ge=-0.3, le=0.3, description="Along y [m].")


class Pushed(Surroundings):
    """What the push did, base frame."""

    robot: str
    arm: str
    object: str
    moved: dict[str, float]
    error_m: float = Field(description="distance from where it was to be")
    position_m: list[float]
    pushes: int
    took_s: float


def strokes_of(one: LocatedObject, shift: F64) -> Iterator[tuple[F64, float]]:
    """Directions (2,) across the object's faces and lengths [m], the longest first, that together
    are a shift (2,).
    """
    axes = UprightBox.of(one).axes
    if one.yaw_rad is None:
        length_m = float(np.linalg.norm(shift))
        axes = np.array([shift / max(length_m, 1e-9)])
    parts = [(float(axis @ shift), axis) for axis in axes]
    for length_m, axis in sorted(parts, key=lambda part: -abs(part[0])):
        if abs(length_m) >= _LEAST_M:
            yield axis * np.sign(length_m), abs(length_m)


def route_of_push(
    one: LocatedObject,
    shift: F64,
    others: Sequence[UprightBox],
    start: Pose,
    hand: HandOptions,
) -> list[Waypoint]:
    """The route of a push by a shift (2,), one stroke across each face.

    Raises:
        RefusedError: rule `covered` or `in_the_way`, with the distance.
    """
    check_uncovered(UprightBox.of(one), others)
    present = yaw_of(matrix_from_quaternion(start.quaternion_xyzw))
    here = np.array(start.position_m)
    tops = [UprightBox.of(one).top_m, *(box.top_m for box in others)]
    over_m = max(tops) + _OVER_M
    route = [Waypoint(what="closed fingers", opening=0.0)]
    if here[2] < over_m:
        up = np.array([*here[:2], over_m])
        route.insert(0, Waypoint(what="the height above all objects", position_m=up))
    for direction, length_m in strokes_of(one, shift):
        stroke = _stroke(one, direction, length_m, others, hand, present, over_m)
        route.extend(stroke)
        moved = one.position_m + length_m * np.array([*direction, 0.0])
        one = replace(one, position_m=moved)
    return route


def _stroke(
    one: LocatedObject,
    direction: F64,
    length_m: float,
    others: Sequence[UprightBox],
    hand: HandOptions,
    present_yaw_rad: float,
    over_m: float,
) -> list[Waypoint]:
    box = UprightBox.of(one)
    contact_m = box.reach(direction) + hand.finger_width_m / 2
    first = box.centre - (contact_m + _BACK_M) * direction
    last = box.centre + (length_m - contact_m) * direction
    low_m = max(float(one.position_m[2]), box.bottom_m + _FLOOR_M)
    yaw = float(np.arctan2(direction[1], direction[0]))
    yaw = min((yaw, yaw + np.pi), key=lambda angle: abs(_turn(present_yaw_rad, angle)))
    _check_way(box, direction, length_m, others)
    _check_hand(first, last, low_m, yaw, others, hand)
    rotation = top_down(yaw)
    places = [(first, over_m), (first, low_m), (last, low_m), (last - 0.01 * direction, low_m)]
    names = ("the place above", "the start of the push", "the end of the push", "the way back")
    route = [
        Waypoint(
            what=name,
            position_m=np.array([*at, height_m]),
            rotation=rotation,
            speed=_SPEED if height_m == low_m else 1.0,
        )
        for name, (at, height_m) in zip(names, places, strict=True)
    ]
    up = np.array([*places[-1][0], over_m])
    return [*route, Waypoint(what="the height above it", position_m=up, rotation=rotation)]


def _turn(start_rad: float, end_rad: float) -> float:
    return float((end_rad - start_rad + np.pi) % (2 * np.pi) - np.pi)


def _check_way(
    box: UprightBox, direction: F64, length_m: float, others: Sequence[UprightBox]
) -> None:
    """Raise RefusedError if the object would be pushed against another."""
    across = np.array([-direction[1], direction[0]])
    swept = UprightBox(
        centre=box.centre + direction * length_m / 2,
        half=np.array([box.reach(direction) + length_m / 2, box.reach(across)]),
        yaw_rad=float(np.arctan2(direction[1], direction[0])),
        bottom_m=box.bottom_m,
        top_m=box.top_m,
    )
    _check_clear(nearest_obstacle((swept,), others), box.name)


def _check_hand(
    first: F64,
    last: F64,
    low_m: float,
    yaw_rad: float,
    others: Sequence[UprightBox],
    hand: HandOptions,
) -> None:
    """Raise RefusedError if the hand would touch another object on the way."""
    count = int(np.linalg.norm(last - first) / 0.01) + 1
    parts = [
        part
        for share in np.linspace(0.0, 1.0, count + 1)
        for part in parts_of_hand(
            np.array([*(first + share * (last - first)), low_m]), yaw_rad, 0.0, hand
        )
    ]
    _check_clear(nearest_obstacle(parts, others), "The hand")


def _check_clear(nearest: tuple[float, str], subject: str) -> None:
    distance_m, name = nearest
    if distance_m < _CLEAR_M:
        raise RefusedError(
            f"{subject} would come to {distance_m * 1000:.1f} mm from {name}, at least "
            f"{_CLEAR_M * 1000:.0f} are needed.",
            hint=f"Move {name} away first, or pick and place instead.",
            rule="in_the_way",
        )


class Pusher:
    """The handler of push for one arm; it moves by move_ee. Follows `Rehearsable`."""

    rehearsal_needs: Needs = frozenset({"control", "scene"})

    def __init__(
        self, host: Host, mover: EndEffectorMover, grip: GripHeight, hand: HandOptions
    ) -> None:
        """Args:
        host: of the feature.
        mover, grip: of the arm.
        hand: measures.
        """
        self._host, self.mover, self.grip = host, mover, grip
        self._hand = hand

    async def __call__(self, arguments: PushArguments, context: CallContext) -> Pushed:
        """Push, look, and push again by what is left, at most three times.

        Raises:
            InvalidInputError: no such object, or several, or no shift.
            RefusedError: it cannot be pushed, with the rule and the distance.
            NotReadyError: nothing can be seen or measured.
            StateError: the object is no longer seen, or did not go where it was to go.
        """
        began_s = time.monotonic()
        looker = looker_of(self._host)
        self.mover.check()
        before, one, route = await planned(
            lambda _: self.plan(arguments, looker, context.who),
            looker,
            self.mover,
            self.grip.arm,
            context,
        )
        carrier = RobotCarrier(self.mover, context)
        goal = one.position_m[:2] + np.array([arguments.dx_m, arguments.dy_m])
        pushes, after, seen = 0, before, one
        while True:
            await run_route(carrier, route, 1.0, self.mover.fastest)
            looker.forget(one)
            pushes += 1
            after = await context.run(partial(_look_anew, looker, context.who, now_ns()))
            seen = self._seen(after, one, goal)
            left = goal - seen.position_m[:2]
            if float(np.linalg.norm(left)) <= _GOOD_M or pushes == _TRIES:
                break
            try:
                route = await context.run(partial(self._next_route, after, seen, left))
            except RefusedError:
                break  # what is left of it is told
            if len(route) <= 2:
                break
        moved_m = seen.position_m[:2] - one.position_m[:2]
        off_m = float(np.linalg.norm(left))
        if off_m > _MISSED_M + seen.uncertainty_m:
            raise StateError(
                f"{told_name(one)} was pushed by {np.round(moved_m, 3).tolist()} m, and is "
                f"{off_m * 1000:.0f} mm from where it was to be.",
                hint=f"What is left: dx_m {left[0]:.3f}, dy_m {left[1]:.3f}. Push from a side that "
                "is free, or pick and place.",
            )
        # it slides on the table: a bad sighting tells its height worst
        height_m = (seen if is_seen_well(seen) else one).position_m[2]
        others = displaced(before, after, one)
        return Pushed(
            robot=self.mover.robot,
            arm=self.grip.arm,
            object=name_of(one),
            moved={
                "dx_m": round(float(moved_m[0]), 4),
                "dy_m": round(float(moved_m[1]), 4),
            },
            error_m=round(off_m, 4),
            position_m=np.round([*seen.position_m[:2], height_m], 4).tolist(),
            pushes=pushes,
            **others.model_dump(exclude_unset=True),
            max_tcp_speed_m_s=carrier.highest_m_s,
            took_s=round(time.monotonic() - began_s, 3),
        )

    def rehearse(self, arguments: PushArguments, rehearsal: Rehearsal) -> None:
        """See `Rehearsable`. The first route only: what would be seen after it is not known."""
        start, looker = self.mover.pose_of(rehearsal.arm), looker_of(self._host)
        _, _, route = self.plan(arguments, looker, rehearsal.context.who, start)
        carry_out_in_twin(self.mover, self.grip, rehearsal, route, 1.0)

    def plan(
        self, arguments: PushArguments, looker: Looker, who: str, start: Pose | None = None
    ) -> tuple[CellLook, LocatedObject, list[Waypoint]]:
        """Look, and plan the push from `start`, the measured pose if None. Raises as `__call__`."""
        self.grip.check_fitted()
        shift = np.array([arguments.dx_m, arguments.dy_m])
        if float(np.linalg.norm(shift)) < _LEAST_M:
            raise InvalidInputError(
                f"Give dx_m or dy_m, together at least {_LEAST_M * 1000:.0f} mm.", path="dx_m"
            )
        if self.grip.holding():
            raise RefusedError(
                f"The hand holds {self.grip.held_name}.", hint="Call place first.", rule="full_hand"
            )
        look, one = seen_target(looker, who, arguments.object, arguments.mark)
        return look, one, self._route(look, one, shift, start)

    def _next_route(
        self, look: CellLook, one: LocatedObject, shift: F64, _: Stage
    ) -> list[Waypoint]:
        return self._route(look, one, shift)

    def _route(
        self, look: CellLook, one: LocatedObject, shift: F64, start: Pose | None = None
    ) -> list[Waypoint]:
        here = self.mover.pose() if start is None else start
        others = [other for other in look.objects if other is not one]
        route = judged(
            lambda seen: route_of_push(one, shift, boxes_of(seen), here, self._hand), others
        )
        check_route(self._host, self.mover, "The push", route, 1.0)
        return route

    def _seen(self, look: CellLook, one: LocatedObject, goal: F64) -> LocatedObject:
        meant = replace(one, position_m=np.array([*goal, one.position_m[2]]))
        found = nearest_like(look.objects, meant, FOLLOW_M)
        if found is None:
            raise StateError(
                f"{told_name(one)} is no longer seen after the push.", hint="Call look."
            )
        return found


def _look_anew(looker: Looker, who: str, since_ns: int, _: Stage) -> CellLook:
    return looker.look(who, since_ns)


def push_tool(
    host: Host,
    movers: Mapping[str, EndEffectorMover],
    grips: Mapping[str, GripHeight],
    hand: HandOptions,
    robot: str,
) -> Tool[PushArguments]:
    """Create push for the arms that have a gripper."""
    pushers = {arm: Pusher(host, movers[arm], grip, hand) for arm, grip in grips.items()}
    return Tool(
        name="push",
        title="Push an object",
        description=f"Push an object over the table with the closed fingers of {robot!r}, and "
        "correct it by looking.",
        arguments=arguments_of(PushArguments, pushers),
        result=Pushed,
        handler=handler_of(pushers),
        simulated_by=frozenset({"twin"}),
        open_world=True,
    )
