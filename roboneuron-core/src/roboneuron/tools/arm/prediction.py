"""Prediction of an arm's motion by actions: control's controller and limits, on ideal joints that
follow at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

from roboneuron.contract import (
    EE_DELTA,
    F64,
    Action,
    Controller,
    ControlSpace,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    RobotProfile,
    SpaceController,
)
from roboneuron.direct_path.joint_messages import joint_commands
from roboneuron.direct_path.message_types import RosMessage
from roboneuron.errors import RefusedError
from roboneuron.gate.motion.joint_paths import check_joints
from roboneuron.gate.motion.joint_space import JointLimit
from roboneuron.gate.motion.limiter import MotionLimiter
from roboneuron.gate.motion.path_limits import Leg, PathLimiter
from roboneuron.gate.motion.rules import MotionRules, inspector_of
from roboneuron.modules.arm_paths import ArmPaths
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint

__all__ = ["ArmControl"]
"""Names that other distributions may use."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Answered:
    """What control makes of a row.

    Attributes:
        command: within the limits; None where the arm is held.
        held: why; empty otherwise.
        rules: limits, by name, that shortened the command or held the arm, or the controller's code
            of a hold.
        is_ignored: the row was refused: the command before it comes to its end.
    """

    command: JointCommand | None
    held: str = ""
    is_ignored: bool = False
    rules: tuple[str, ...] = ()


class ArmControl:
    """Control's controller and limits of an arm, for one user, who closes it.

    Attributes:
        controller: loaded.
        profile: with the collisions in force.
        rules: limits in force.
    """

    def __init__(
        self,
        controller: Controller,
        limiter: MotionLimiter,
        profile: RobotProfile,
        rules: MotionRules,
    ) -> None:
        self.controller, self.profile, self.rules = controller, profile, rules
        self._limiter = limiter

    @classmethod
    def of(cls, host: Host, exposed: ExposedEndpoint) -> ArmControl:
        """Create them as control has them, for the robot of an endpoint with a profile.

        Raises:
            ConfigurationError, MissingDependencyError, PluginError: there is no controller for the
                arm of that endpoint.
        """
        assert exposed.profile is not None
        config = host.loop.base
        paths = ArmPaths(config, lambda: host.registry, lambda: host.loop.limits)
        controller, profile = paths.load(exposed.robot, exposed.profile)
        rules = paths.rules(exposed.robot, profile)
        limiter = MotionLimiter.of(
            rules,
            profile,
            controller,
            immediate=config.control is not None and config.control.command == "joint_state",
            longest_s=config.robot.server_timeout_s,
        )
        return cls(controller, limiter, profile, rules)

    def poses(self, joints: JointSample) -> tuple[Pose, ...]:
        """TCP pose of each arm in the base frame. Raises UnsafeError as `Controller.forward`."""
        return self._limiter.poses(joints)

    def rest(self, joints: JointSample, now_s: float) -> None:
        """See `MotionLimiter.rest`."""
        self._limiter.rest(joints, now_s)

    def answer(
        self, space: ControlSpace, row: F64, joints: JointSample, now_s: float, step_s: float
    ) -> Answered:
        """What control makes of a row.

        Args:
            space, row: what is asked for.
            joints: measured.
            now_s: time, as `MotionLimiter` counts it.
            step_s: time that the row has.
        """
        limiter = self._limiter
        answer: JointCommand | Hold
        if space is EE_DELTA:
            answer = self.controller.compute(Action.from_vector(row), joints, step_s)
        else:
            start = limiter.reference(joints, now_s)
            # control has looked whether it can
            controller = cast("SpaceController", self.controller)
            answer = controller.execute(space, row, start, step_s)
        if isinstance(answer, Hold):
            return Answered(command=None, held=answer.reason, rules=(answer.code,))
        verdict = limiter.limit(answer, joints, now_s)
        if isinstance(verdict.command, JointCommand):
            return Answered(command=verdict.command, rules=verdict.acted)
        return Answered(
            command=None,
            held=verdict.reason,
            rules=verdict.acted,
            is_ignored=verdict.command is None,
        )

    def path(self, messages: Sequence[object], joints: JointSample) -> list[Leg]:
        """The joint path of trajectories that begin at `joints`, judged as the gate does. Raises
        RefusedError.
        """
        limits = JointLimit.by_joint(self.profile, self.rules)
        commands = [
            command
            for message in messages
            for command in joint_commands(cast("RosMessage", message))
        ]
        try:
            legs = check_joints(limits, commands, joints)
            PathLimiter(self.rules, self.profile, inspector_of(self.controller)).check(legs, joints)
        except RefusedError as error:
            error.rule = error.rule or "joints"
            raise
        return legs

    def close(self) -> None:
        """Release the controller; may be called twice."""
        self.controller.close()


class PredictedArm:
    """Simulated arms of a robot; used from one thread.

    Attributes:
        held: reason why the newest action was not executed; empty if it was, shortened or not.
    """

    def __init__(self, control: ArmControl, joints: JointSample) -> None:
        """Args:
        control: for exclusive use.
        joints: initial state, at rest.
        """
        self.held = ""
        self._control, self._joints = control, joints
        self._now_s = 0.0
        control.rest(joints, self._now_s)

    def poses(self) -> tuple[Pose, ...]:
        """TCP pose of each arm in the base frame. Raises UnsafeError as `Controller.forward`."""
        return self._control.poses(self._joints)

    def follow(self, space: ControlSpace, row: F64, step_s: float) -> None:
        """Execute a row of a space for `step_s`, as far as the limits allow; the arm stays in place
        if one holds it.
        """
        self._now_s += step_s
        answered = self._control.answer(space, row, self._joints, self._now_s, step_s)
        outcome, self.held = answered.command, answered.held
        if outcome is None:
            self._control.rest(self._joints, self._now_s)
            return
        share = min(1.0, step_s / outcome.duration_s)
        ends = dict(zip(outcome.names, outcome.position.tolist(), strict=True))
        position = self._joints.position.copy()
        for index, name in enumerate(self._joints.names):
            position[index] += share * (ends.get(name, position[index]) - position[index])
        self._joints = JointSample(
            names=self._joints.names, position=position, stamp_ns=self._joints.stamp_ns
        )

    def close(self) -> None:
        """Release the controller; may be called twice."""
        self._control.close()
