"""Motions to postures, places, positions and objects, with the tools of the arm."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from pydantic import Field

from rn_standard.tasks.named_targets import Places
from rn_standard.tasks.options import PlaceOptions
from rn_standard.tasks.run_task import profile_of
from roboneuron import (
    F64,
    Arguments,
    ArmProfile,
    CallContext,
    Host,
    InvalidInputError,
    NotReadyError,
    RefusedError,
    Result,
    StateError,
    matrix_from_quaternion,
)
from roboneuron.server.rehearsal import Rehearsal
from roboneuron.sight.looker import seen_top
from roboneuron.tools.arm.absolute import go_to, wanted_rotation
from roboneuron.tools.arm.bounds import check_targets
from roboneuron.tools.arm.grip import check_gripper
from roboneuron.tools.arm.options import fastest

_ABOVE_M = 0.10
"""Height of the TCP over the top of an object to which it moves."""
PoseNow = Callable[[str], tuple[F64, F64]]
"""Waits for the measured TCP pose of an arm, "" for the only one; returns position (3,) [m] and
rotation (3, 3) in the base frame.
"""

CallArm = Callable[[str, Mapping[str, object], CallContext], Awaitable[dict[str, Any]]]
"""Calls a tool of the arm by its name; returns what it answers. Raises as the tool."""


class MoveToArguments(Arguments):
    """Arguments of move_to."""

    name: str | None = Field(default=None, description="Posture, gesture or place.")
    arm: str = Field(default="", description="Which of several arms.")
    position_m: Annotated[list[float], Field(min_length=3, max_length=3)] | None = Field(
        default=None, description="Of the TCP, base frame."
    )
    object: str = Field(default="", description="Over an object that look names.")
    mark: int | None = Field(default=None, ge=1, description="Of your last look.")
    yaw_deg: float | None = Field(
        default=None, description="Of the hand, pointing down; kept if omitted."
    )
    quaternion_xyzw: Annotated[list[float], Field(min_length=4, max_length=4)] | None = Field(
        default=None, description="Instead of a yaw."
    )
    above_m: float | None = Field(
        default=None,
        ge=0,
        le=0.5,
        description="Over the object (0.1), or over the position first.",
    )
    speed: float = Field(default=1.0, gt=0.02, le=1, description="Fraction of the fastest.")


class MovedTo(Result):
    """The arm was measured at the target."""

    name: str
    kind: str = Field(description="posture, gesture, place, position or object")
    error: float = Field(
        description="largest distance from a joint's target [rad or m], or of the TCP [m]"
    )
    took_s: float
    position_m: list[float] = Field(default=[], description="measured TCP, base frame")
    yaw_deg: float | None = None
    joint_margin: dict[str, float] = Field(
        default={}, description="joint nearest to its limit, distance [rad or m]"
    )
    max_tcp_speed_m_s: float | None = None
    holding: bool | None = Field(default=None, description="it holds something; null: unknown")


@runtime_checkable
class JudgesPath(Protocol):
    """A handler of move_joints that judges several of its calls before the first."""

    def check_path(
        self,
        steps: Sequence[Mapping[str, float]],
        context: CallContext,
        rehearsal: Rehearsal | None = None,
    ) -> None:
        """Raise RefusedError for positions that one of these calls may not reach; blocks.

        Args:
            steps: positions by joint, of each call.
            context: of the call.
            rehearsal: where the arm stands; None for the robot.
        """


class Mover:
    """Moves to a posture or place by calling move_joints or move_ee on behalf of the same
    client.
    """

    def __init__(
        self,
        host: Host,
        places: Places,
        pose_now: PoseNow,
        call: CallArm | None = None,
        judge: JudgesPath | None = None,
    ) -> None:
        """Args:
        host: of the feature.
        places: those it knows.
        pose_now: tells where the arm is.
        call: what moves the arm instead of the tools.
        judge: of its paths; the tool move_joints if None.
        """
        self._host = host
        self._places = places
        self._pose_now = pose_now
        self._call = call or self._call_tool
        self._judge = judge

    async def __call__(self, name: str, context: CallContext, speed: float = 1.0) -> MovedTo:
        """Move to a named target, at a fraction of the usual speed.

        Raises:
            InvalidInputError: no such name.
            NotReadyError: the tool that moves the arm is missing.
            RoboNeuronError: as move_joints and move_ee.
        """
        motions, places = self._places.motions(), self._places.places()
        if name in motions:
            kind, steps = motions[name]
            return await self._through(name, kind, steps, speed, context)
        if name in places:
            return await self._to_place(name, places[name], speed, context)
        known = (
            ", ".join(self._places.choices())
            or "none; a person adds them as [postures.<name>], [gestures.<name>] or [places.<name>]"
        )
        raise InvalidInputError(
            f"There is no posture, gesture or place {name[:64]!r}.",
            hint=f"There are: {known}.",
            path="name",
        )

    async def _through(
        self,
        name: str,
        kind: str,
        steps: Sequence[Mapping[str, float]],
        speed: float,
        context: CallContext,
    ) -> MovedTo:
        """Move the joints through postures, of which all are judged before the first motion. Raises
        StateError after a stop on the way.
        """
        check = self._stop_check(name)
        took_s, error = 0.0, 0.0
        tool = self._host.tools.get("move_joints")
        judge = self._judge or (None if tool is None else tool.handler)
        if len(steps) > 1 and isinstance(judge, JudgesPath):
            await context.run(lambda _: judge.check_path(steps, context))
        for number, joints in enumerate(steps):
            check()
            order: dict[str, object] = {"positions": dict(joints)}
            try:
                if speed < 1:
                    usual = await self._call("move_joints", order, _Judged(context))
                    order["duration_s"] = usual["duration_s"] / speed
                answer = await self._call("move_joints", order, context)
            except RefusedError as refused:
                if not number:
                    raise
                told = f"The arm stands after steps[{number - 1}] of {name!r}. {refused.message}"
                raise RefusedError(told, hint=refused.hint, rule=refused.rule) from refused
            took_s, error = took_s + answer["duration_s"], answer["error"]
        return MovedTo(name=name, kind=kind, error=error, took_s=round(took_s, 3))

    def _stop_check(self, name: str) -> Callable[[], None]:
        """A function that raises StateError once there was a stop after now: what is left of the
        motion must not be made.
        """
        starts = self._host.loop.starts
        stops = starts.arm_stops

        def check() -> None:
            if starts.arm_stops != stops:
                raise StateError(f"It was stopped on its way to {name!r}: {starts.reason}.")

        return check

    async def go(self, arguments: MoveToArguments, context: CallContext) -> MovedTo:
        """Move to the target of a call, and measure the motion.

        Raises:
            InvalidInputError: it names no target, or several.
            NotReadyError, RefusedError: it cannot be seen, or as move_joints and move_ee.
        """
        targets = {
            "name": arguments.name is not None,
            "position_m": arguments.position_m is not None,
            "object": bool(arguments.object),
            "mark": arguments.mark is not None,
        }
        given = [name for name, is_given in targets.items() if is_given]
        if len(given) != 1:
            told = " and ".join(given) or "no target"
            raise InvalidInputError(
                f"The call gives {told}; give one of {', '.join(targets)}.", path="name"
            )
        if arguments.name is None:
            return await self._to_pose(arguments, context)
        moot = {"yaw_deg", "quaternion_xyzw", "above_m"} & arguments.given().keys()
        if moot:
            raise InvalidInputError(
                f"A named target is a whole pose: leave {', '.join(sorted(moot))} away.",
                path=sorted(moot)[0],
            )
        return await self(arguments.name, context, arguments.speed)

    async def _to_pose(self, arguments: MoveToArguments, context: CallContext) -> MovedTo:
        arm = arguments.arm
        _check_arm(self._host, arm, "The call", "arm")
        _, present = await context.run(lambda _: self._pose_now(arm))
        rotation = wanted_rotation(arguments.yaw_deg, arguments.quaternion_xyzw, present)
        if arguments.position_m is None:
            position, name = await context.run(lambda _: self._over_object(arguments, context.who))
            first = None
        else:
            position, name = np.array(arguments.position_m), str(arguments.position_m)
            first = position + np.array([0.0, 0.0, arguments.above_m or 0.0])
        took_s, error_m = 0.0, 0.0
        targets = [position] if first is None or not arguments.above_m else [first, position]
        await self._check_route(arm, targets, rotation, name, arguments.speed, context)
        for target in targets:
            error_m, part_s = await self._straight(
                arm, target, rotation, name, arguments.speed, context
            )
            took_s += part_s
        kind = "object" if arguments.position_m is None else "position"
        return MovedTo(name=name, kind=kind, error=round(error_m, 5), took_s=round(took_s, 3))

    def _over_object(self, arguments: MoveToArguments, who: str) -> tuple[F64, str]:
        """Position of the TCP over an object, and its name."""
        top, name = seen_top(self._host, who, arguments.object, arguments.mark)
        above_m = _ABOVE_M if arguments.above_m is None else arguments.above_m
        return top + np.array([0.0, 0.0, above_m]), name

    async def _to_place(
        self, name: str, place: PlaceOptions, speed: float, context: CallContext
    ) -> MovedTo:
        _check_arm(self._host, place.arm, f"The place {name!r}", f"[places.{name}]")
        arm: dict[str, object] = {"arm": place.arm} if place.arm else {}
        gripper = {} if place.gripper_open is None else {"gripper_open": place.gripper_open}
        if gripper:
            check_gripper(self._host, profile_of(self._host), place.arm)
        rotation = None
        if place.quaternion_xyzw is not None:
            wanted = np.array(place.quaternion_xyzw)
            rotation = matrix_from_quaternion(wanted / np.linalg.norm(wanted))
        position = np.array(place.position_m)
        await self._check_route(place.arm, [position], rotation, repr(name), speed, context)
        error_m, took_s = await self._straight(place.arm, position, rotation, name, speed, context)
        if gripper:
            took_s += (await self._call("move_ee", {**arm, **gripper}, context))["duration_s"]
        return MovedTo(name=name, kind="place", error=round(error_m, 5), took_s=round(took_s, 3))

    async def _check_route(
        self,
        arm: str,
        targets: Sequence[F64],
        rotation: F64 | None,
        name: str,
        speed: float,
        context: CallContext,
    ) -> None:
        """Raise RefusedError unless the arm would get to these places; nothing moves. A twin, and
        an arm that something else moves, judge by themselves.
        """
        if self._judge is None:
            await context.run(
                lambda _: check_targets(self._host, arm, targets, rotation, what=name, speed=speed)
            )

    async def _straight(
        self,
        arm: str,
        position: F64,
        rotation: F64 | None,
        name: str,
        speed: float,
        context: CallContext,
    ) -> tuple[float, float]:
        """Move in straight parts; return the distance left [m] and the time taken [s]."""
        check, took_s = self._stop_check(name), 0.0
        of_arm: dict[str, object] = {"arm": arm} if arm else {}

        async def pose_now() -> tuple[F64, F64]:
            return await context.run(lambda _: self._pose_now(arm))

        async def move(part: dict[str, float]) -> None:
            nonlocal took_s
            took_s += (await self._call("move_ee", {**of_arm, **part}, context))["duration_s"]

        error_m = await go_to(
            pose_now,
            move,
            position,
            rotation,
            what=repr(name),
            speed=speed,
            fastest=self._fastest() if speed < 1 else (1.0, 1.0),
            check=check,
        )
        return error_m, took_s

    def _fastest(self) -> tuple[float, float]:
        feature = self._host.features.loaded.get("tools-arm")
        if feature is None:
            return (1.0, 1.0)
        return fastest(feature.options, self._host.loop.limits)

    async def _call_tool(
        self, tool_name: str, arguments: Mapping[str, object], context: CallContext
    ) -> dict[str, Any]:
        tool = self._host.tools.get(tool_name)
        if tool is None:
            raise NotReadyError(
                f"There is no tool {tool_name} now.", hint="It comes with rn-tools-arm and an arm."
            )
        answer = await tool.call(arguments, context)
        is_simulated = answer.structured.get("simulated") and not context.simulated
        if not answer.structured.get("allowed", True) or is_simulated:
            raise RefusedError(
                f"The arm was not moved: {answer.structured.get('reason') or 'only simulated'}.",
                rule="simulate",
            )
        return dict(answer.structured)


def _check_arm(host: Host, arm: str, subject: str, where: str) -> None:
    """Raise InvalidInputError for an arm that the robot does not have."""
    arms = [one.name for one in _arms(host)]
    if arm in (arms or [""]):
        return
    told = f"names the arm {arm[:64]!r}" if arm else "names no arm"
    known = f"the arms are {', '.join(map(repr, arms))}" if arms else "the only one has none"
    raise InvalidInputError(f"{subject} {told}; {known}.", hint=f"Set arm: {where}.", path="arm")


def _arms(host: Host) -> tuple[ArmProfile, ...]:
    """The arms of a robot with several."""
    profile = profile_of(host)
    return () if profile is None else profile.arms


class _Judged:
    """A context whose calls are only judged."""

    simulated = True

    def __init__(self, context: CallContext) -> None:
        self.who, self.role = context.who, context.role
        self.run, self.ask = context.run, context.ask
