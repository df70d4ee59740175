"""One simulation: the calls of the arm's tools, carried out in a twin."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NoReturn, TypeVar, cast

import numpy as np

from rn_standard.simulate.arm import TwinArm
from rn_standard.simulate.results import Outcome
from rn_standard.simulate.task import run_in_twin
from rn_standard.simulate.twin_process import TwinProcess
from rn_standard.tasks.moving import Mover, MoveToArguments
from rn_standard.tasks.named_targets import Places
from rn_standard.tasks.run_task import RunTask, TaskTool
from roboneuron import (
    F64,
    CallContext,
    Controller,
    Host,
    NotReadyError,
    RefusedError,
    RobotProfile,
    StateError,
    Tool,
    matrix_from_quaternion,
)
from roboneuron.direct_path.joint_messages import joint_commands
from roboneuron.feature import ExposedEndpoint, MotionRules, Stage, inspector_of, joint_space
from roboneuron.gate.motion.joint_paths import check_joints
from roboneuron.gate.motion.path_limits import Leg, PathLimiter
from roboneuron.modules.arm_paths import ArmPaths
from roboneuron.sight.looker import looker_of
from roboneuron.tools.arm.ee_move import MoveEndEffector
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.grip import Grip, is_blocked
from roboneuron.tools.arm.joints import JointMover, MoveJoints
from roboneuron.tools.arm.picking import PickArguments, Picker
from roboneuron.tools.arm.place_plans import PlaceArguments
from roboneuron.tools.arm.placing import Placer
from roboneuron.tools.arm.pushing import PushArguments, Pusher
from roboneuron.tools.arm.routes import DrivenCarrier, Waypoint, run_route
from roboneuron.tools.arm.several_arms import OfArm
from roboneuron.tools.ros.publish import Publish, Publishing, encode_step

T = TypeVar("T")
MODELS = (
    *(MoveEndEffector, MoveJoints, MoveToArguments, PickArguments, PlaceArguments),
    *(PushArguments, Publish, RunTask),
)
"""Arguments of the tools that the twin can simulate."""


class EndedError(Exception):
    """The motion would not come to its end."""

    def __init__(self, outcome: Outcome, rule: str, reason: str) -> None:
        super().__init__(reason)
        self.outcome, self.rule = outcome, rule


class _Inline:
    """A CallContext for what runs on the thread of the simulation already."""

    simulated = True

    def __init__(self, context: CallContext) -> None:
        self.who, self.role = context.who, context.role

    async def run(
        self,
        work: Callable[[Stage], T],
        *,
        on_cancel: Callable[[], object] = lambda: None,
        on_leave: Callable[[], object] | None = None,
    ) -> T:
        return work(lambda _: None)

    async def ask(self, question: str, what: str = "") -> str | None:
        return None


class _TwinCarrier(DrivenCarrier):
    """The twin, whose hand may close on nothing and whose arm comes to rest after each part."""

    def __init__(
        self,
        mover: EndEffectorMover,
        arm: TwinArm,
        is_blocked: Callable[[float], bool],
        opening: float,
    ) -> None:
        super().__init__(mover, arm)
        self._twin_arm, self._is_blocked = arm, is_blocked
        self._opening = opening

    async def move(self, fields: dict[str, float]) -> None:
        """See `Carrier`. The hand keeps the opening that the route gave it."""
        self._opening = fields.get("gripper_open", self._opening)
        await super().move({**fields, "gripper_open": self._opening})
        self._twin_arm.settle()

    def check_holds(self) -> None:
        """See `Carrier`."""
        if not self._is_blocked(self._opening):
            raise StateError("The hand closes on nothing.")


class Session:
    """Carries out calls one after the other, from where the one before has ended; one thread.

    Attributes:
        arm: of the twin.
    """

    def __init__(
        self,
        host: Host,
        exposed: ExposedEndpoint,
        profile: RobotProfile,
        rules: MotionRules,
        controller: Controller,
        arm: TwinArm,
        twin: TwinProcess,
        context: CallContext,
    ) -> None:
        """Args:
        host: of the feature.
        exposed: an endpoint of the robot.
        profile: with the collisions in force.
        rules: limits in force.
        controller: of control, loaded.
        arm: of the twin.
        twin: that of the arm.
        context: of the call.
        """
        self._host, self._exposed, self._profile, self._rules = host, exposed, profile, rules
        self.arm, self._twin, self._context = arm, twin, context
        self._paths = PathLimiter(rules, profile, inspector_of(controller))

    def call(self, tool: Tool[Any], arguments: object) -> None:
        """Carry out a call. Raises EndedError when it does not come to its end, and what the tool
        raises for a call that makes no sense.
        """
        if isinstance(arguments, MoveEndEffector):
            self._move_ee(tool, arguments)
        elif isinstance(arguments, MoveJoints):
            self._move_joints(cast("JointMover", tool.handler), arguments)
        elif isinstance(arguments, MoveToArguments):
            self._move_to(arguments)
        elif isinstance(arguments, PickArguments | PushArguments):
            self._grasp_or_push(tool, arguments)
        elif isinstance(arguments, PlaceArguments):
            self._place(tool, arguments)
        elif isinstance(arguments, RunTask):
            self._run_task(cast("TaskTool", tool.handler), arguments)
        else:
            self._trajectory(cast("Publishing", tool.handler), cast("Publish", arguments))

    def _move_ee(self, tool: Tool[Any], arguments: MoveEndEffector) -> None:
        handler = tool.handler
        mover = handler.of(arguments.arm) if isinstance(handler, OfArm) else handler
        assert isinstance(mover, EndEffectorMover)
        self._move(mover, arguments)

    def _move(self, mover: EndEffectorMover, arguments: MoveEndEffector) -> None:
        try:
            order = mover.order(arguments)
        except RefusedError as error:
            _refuse(error)
        try:
            for _ in mover.drive(order, self.arm):
                pass
        except RefusedError as error:
            held = bool(self.arm.held)
            self.arm.settle()
            outcome: Outcome = "blocked" if self._twin.moved() and not held else "stopped"
            raise EndedError(outcome, self.arm.rule or error.rule, error.message) from error
        self.arm.settle()

    def _grasp_or_push(self, tool: Tool[Any], arguments: PickArguments | PushArguments) -> None:
        """The first route only: what would be seen after it is not known."""
        handler, looker = tool.handler, looker_of(self._host)
        of_arm = handler.of(arguments.arm) if isinstance(handler, OfArm) else handler
        assert isinstance(of_arm, Picker | Pusher)
        start, who = of_arm.mover.pose_of(self.arm), self._context.who
        speed = 1.0
        try:
            if isinstance(of_arm, Picker):
                assert isinstance(arguments, PickArguments)
                speed = arguments.speed
                _, _, route = of_arm.plan(arguments, looker, who, start)
            else:
                assert isinstance(arguments, PushArguments)
                _, _, route = of_arm.plan(arguments, looker, who, start)
        except RefusedError as error:
            _refuse(error)
        holds = partial(self._holds, of_arm.grip)
        carrier = _TwinCarrier(of_arm.mover, self.arm, holds, of_arm.grip.kept())
        self._run(of_arm.mover, carrier, route, speed)

    def _run(
        self,
        mover: EndEffectorMover,
        carrier: DrivenCarrier,
        route: Sequence[Waypoint],
        speed: float,
    ) -> None:
        try:
            asyncio.run(run_route(carrier, route, speed, mover.fastest))
        except (RefusedError, StateError) as error:
            held = bool(self.arm.held)
            self.arm.settle()
            outcome: Outcome = "blocked" if self._twin.moved() and not held else "stopped"
            rule = error.rule if isinstance(error, RefusedError) else "lost"
            raise EndedError(outcome, self.arm.rule or rule, error.message) from error
        self.arm.settle()

    def _place(self, tool: Tool[Any], arguments: PlaceArguments) -> None:
        """With the twin's hand, which may lose what it holds as the robot's may."""
        handler = tool.handler
        placer = handler.of(arguments.arm) if isinstance(handler, OfArm) else handler
        assert isinstance(placer, Placer)
        names = [part.name for part in self._profile.each_arm]
        try:
            placer.check_holds()
        except RefusedError as error:
            _refuse(error)
        start = placer.mover.pose_of(self.arm)
        try:
            plan = placer.plan(arguments, self._context.who, start)
        except RefusedError as error:
            _refuse(error)
        if plan is not None:
            holds = partial(self._holds, placer.grip)
            kept = placer.grip.kept()
            carrier = _TwinCarrier(placer.mover, self.arm, holds, kept)
            self._run(placer.mover, carrier, plan.route, arguments.speed)
            return
        route = placer.route(arguments, self.arm.poses()[names.index(arguments.arm)])
        for move in route.carry:
            self._move(placer.mover, move)
            if not self._holds(placer.grip, placer.grip.kept()):
                raise EndedError("stopped", "lost", "The hand loses what it holds on the way.")
        self._move(placer.mover, route.release)
        for move in route.leave:
            opened = move.model_copy(update={"gripper_open": route.release.gripper_open})
            self._move(placer.mover, opened)

    def _holds(self, grip: Grip, commanded: float) -> bool:
        """Whether the fingers of the twin are kept from a commanded opening."""
        gripper, joints = grip.profile, self.arm.joints()
        assert gripper is not None
        opening = gripper.opening_in(joints)
        return opening is not None and is_blocked(opening, commanded)

    def _move_joints(self, mover: JointMover, arguments: MoveJoints) -> None:
        mover.check(arguments)
        try:
            request, _ = mover.request(arguments, self.arm.joints(), self._context)
        except RefusedError as error:
            _refuse(error)
        self._play(request.messages[0])

    def _trajectory(self, handler: Publishing, arguments: Publish) -> None:
        exposed, interface = handler.endpoints[arguments.robot]
        if exposed.namespace != self._exposed.namespace:
            raise NotReadyError("Only trajectories of this server's own arm can be simulated.")
        self._play(encode_step(interface, arguments.message, 0.0).message)

    def check_path(self, steps: Sequence[Mapping[str, float]], context: CallContext) -> None:
        """See `JudgesPath`; raises EndedError for a path that is refused."""
        tool = self._host.tools.get("move_joints")
        if tool is None:
            return  # the call says so
        mover = cast("JointMover", tool.handler)
        try:
            request = mover.path_request(steps, self.arm.joints(), context)
        except RefusedError as error:
            _refuse(error)
        self._legs(request.messages)

    def _play(self, message: Any) -> None:
        """A joint trajectory: judged as the gate does, then played."""
        legs = self._legs([message])
        if not self.arm.play(legs):
            reason = "The joints do not come to the end of the way."
            raise EndedError("blocked" if self._twin.moved() else "stopped", "path", reason)

    def _legs(self, messages: Sequence[Any]) -> list[Leg]:
        """The path of joint trajectories, judged as the gate does. Raises EndedError."""
        joints = self.arm.joints()
        limits = joint_space.JointLimit.by_joint(self._profile, self._rules)
        commands = [command for message in messages for command in joint_commands(message)]
        try:
            legs = check_joints(limits, commands, joints)
            self._paths.check(legs, joints)
        except RefusedError as error:
            error.rule = error.rule or "joints"
            _refuse(error)
        return legs

    def _move_to(self, arguments: MoveToArguments) -> None:
        tasks = self._host.features.loaded["tasks"]
        places = Places(self._host, tasks.options)
        mover = Mover(self._host, places, self._pose_now, self._call_by_name, judge=self)
        if arguments.name is not None:  # at the usual speed: a slower one takes the same path
            arguments = arguments.model_copy(update={"speed": 1.0})
        asyncio.run(_go(mover, arguments, cast("CallContext", _Inline(self._context))))

    def _run_task(self, handler: TaskTool, arguments: RunTask) -> None:
        """The task's own rules; what is done after its end is not looked at."""
        judge, plan = handler.rehearsal(arguments, self._profile)
        end = run_in_twin(self._host, self.arm, self._twin, self._profile, judge, plan)
        if end.outcome != "succeeded":
            outcome: Outcome = "unclear" if end.outcome == "unclear" else "stopped"
            raise EndedError(outcome, end.outcome.value, f"{end.reason.rstrip('.')}.")

    async def _call_by_name(
        self, name: str, arguments: Mapping[str, object], _: CallContext
    ) -> dict[str, Any]:
        tool = self._host.tools.get(name)
        if tool is None:
            raise NotReadyError(
                f"There is no tool {name} now.", hint="It comes with rn-tools-arm and an arm."
            )
        began_s = self.arm.passed_s
        self.call(tool, tool.parsed(arguments))
        return {"duration_s": self.arm.passed_s - began_s, "error": 0.0}

    def _pose_now(self, arm: str) -> tuple[F64, F64]:
        names = [part.name for part in self._profile.each_arm]
        pose = self.arm.poses()[names.index(arm)]
        return np.array(pose.position_m), matrix_from_quaternion(pose.quaternion_xyzw)


async def _go(mover: Mover, arguments: MoveToArguments, context: CallContext) -> None:
    await mover.go(arguments, context)


def arm_endpoint(host: Host) -> ExposedEndpoint:
    """An endpoint of the present arm. Raises NotReadyError."""
    found = next(
        (
            one
            for one in host.gate.exposed
            if one.robot == host.config.robot.name
            and one.profile is not None
            and one.profile.tcp_link
        ),
        None,
    )
    if found is None:
        raise NotReadyError("There is no arm here whose motion could be simulated.")
    return found


def paths_of(host: Host) -> ArmPaths:
    """Controller and limits in force, as the gate has them."""
    return ArmPaths(host.loop.base, lambda: host.registry, lambda: host.loop.limits)


def _refuse(error: RefusedError) -> NoReturn:
    raise EndedError("refused", error.rule, str(error)) from error
