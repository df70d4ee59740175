"""Control: actions and measured joints in, joint commands within the limits out."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from rn_standard.control.planning import find_controller
from roboneuron import (
    EE_DELTA,
    F64,
    Action,
    ConfigurationError,
    Controller,
    ControllerSpec,
    ControlSpace,
    Hold,
    InvalidInputError,
    JointCommand,
    JointSample,
    Pose,
    PostureInspector,
    RoboNeuronError,
    RobotProfile,
    SeveralArms,
    SpaceController,
    UnsafeError,
    robot_space,
)
from roboneuron.node import (
    HoldingModule,
    LimitedCommand,
    ModuleHost,
    build,
    find_robot,
    messages,
    split_label,
    topics,
)

_POSE_PERIOD_S = 0.02
"""The pose of the TCP is worked out 50 times a second, not for each of up to 1000 joint states."""
_SHARE_OF_REST = 0.5
"""How much of the time that is left of a row the next one is given beside its own: with all of it
the arm would stay behind for ever, with none it would catch up at once.
"""
_ROUNDING_S = 1e-6
"""Of a horizon that is a whole number of periods."""
_MOST_PLANNED = 50
"""Rows after the one that is due: each of them is computed with every row that comes."""
log = logging.getLogger(__name__)


class ControlModule(HoldingModule):
    """Executes actions one by one; everything happens in the executor's thread.

    Attributes:
        robot: name of the robot that it moves.
        on_limited: called with what the limits made of each command, before that is sent.
    """

    def __init__(self, node: ModuleHost) -> None:
        """Load the controller and subscribe.

        Raises:
            ConfigurationError: there is no [control] section, the limits do not fit the robot, or
                the tightened ones are wider than the configured ones.
            PlanningError: the controller cannot move this robot.
        """
        super().__init__(node)
        # a command of ours has gone out: from then on the predecessor's count no more
        self._is_sent = False
        self._pose_s = 0.0
        robot, _ = find_robot(
            self.registry, self.profile.name, self.config.robot.driver, is_elsewhere=True
        )
        spec = find_controller(self.registry, self.section.controller, robot)
        self._controller = cast(
            "Controller", build(spec, self.config.options(spec.name), self.profile)
        )
        node.resources.callback(self._controller.close)
        self._controller.load()
        self._spaces = _executed_spaces(spec, self._controller, self.profile)
        # the newest command goes on by itself after its row
        self._has_plan = False
        # of the newest action; None before the first, so that its label is always looked at
        self._space: ControlSpace | None = None
        self.limit_with(self._controller)
        self.robot = self.profile.name
        self.on_limited: list[Callable[[LimitedCommand], None]] = []
        self._report_collision_check()
        self._ee_pose = node.advertise(PoseStamped, topics.EE_POSE)
        self._arm_poses = [
            node.advertise(PoseStamped, f"{arm.name}/{topics.EE_POSE}") for arm in self.profile.arms
        ]
        node.subscribe(JointState, topics.JOINT_STATES, self._on_joint_state)
        node.subscribe(Float64MultiArray, topics.ACTION, self._on_action)
        self.status.set_value("controller", spec.name)

    def follow(self, message: JointTrajectory | JointState, sent_s: float) -> JointCommand:
        """Go on from where a command of the control before this one has sent the arm.

        Args:
            message: as that control has published it.
            sent_s: when [monotonic s].

        Returns:
            The command.

        Raises:
            InvalidInputError: it is malformed.
        """
        command = messages.commands_from_message(message)[0]
        joints = self.watched.joints
        if not self._is_sent and joints is not None:
            self.limiter.follow(command, joints, sent_s)
            self.action_s, self.is_holding = sent_s, False
        return command

    def _report_collision_check(self) -> None:
        """Say whether commands are checked for collisions, which not every controller can."""
        has_bodies = self.profile.collision is not None
        is_checked = has_bodies and isinstance(self._controller, PostureInspector)
        if has_bodies and not is_checked:
            log.warning(
                "The controller tells no distances: collisions of %s are not checked.", self.robot
            )
        self.status.set_value("collision_checked", is_checked)

    def _on_joint_state(self, message: JointState) -> None:
        now_s = time.monotonic()
        try:
            joints = messages.joints_from_message(message)
            if not self.believe(joints, now_s):
                return
            if now_s - self._pose_s >= _POSE_PERIOD_S or self.handover.is_shadow(joints.stamp_ns):
                self._publish_pose(joints)
                self._pose_s = now_s
        except RoboNeuronError as error:
            self.status.drop("bad_joint_state")
            self.status.set_error(error)

    def _publish_pose(self, joints: JointSample) -> None:
        """Tell where the TCP of each arm is measured, which is what proves that control works.

        Raises:
            UnsafeError: the controller cannot tell it from these joints.
        """
        poses = self.poses(joints)
        if self.handover.is_shadow(joints.stamp_ns):
            self.handover.withhold(poses[0])
        elif not self.handover.is_over(joints.stamp_ns):
            self._send_poses(poses)
            self.handover.note_sent("pose")
        self.status.clear_error()
        self.status.set_ready()

    def _send_poses(self, poses: tuple[Pose, ...]) -> None:
        """The first arm's pose goes out as the robot's, and each of several arms' as its own."""
        self._ee_pose.publish(messages.to_pose_stamped(poses[0], self.profile.base_link))
        for publisher, pose in zip(self._arm_poses, poses, strict=False):
            publisher.publish(messages.to_pose_stamped(pose, self.profile.base_link))

    def _on_action(self, message: Float64MultiArray, info: dict[str, Any]) -> None:
        """Execute an action, or count why not. Its age is that since it was sent, by the time stamp
        that DDS adds: the message has none.
        """
        source_ns = int(info["source_timestamp"])
        if not self.is_active or self.handover.is_over(source_ns):
            return
        age_s = (time.time_ns() - source_ns) / 1e9
        reason = self.why_not(age_s, source_ns)
        if reason is not None:
            self.status.drop(reason)
            return
        try:
            label, values = messages.row_from_action_message(message)
            space = self._space
            if space is None or label != space.label:
                space = self._space = self._agreed_space(label)
            row = space.check(values)
            planned = messages.PlannedRows.from_action_message(message)
            for later in () if planned is None else planned.rows[:_MOST_PLANNED]:
                space.check(later)
        except RoboNeuronError as error:
            self.status.drop("non_finite" if isinstance(error, UnsafeError) else "malformed")
            self.status.set_error(error)
            return
        self._execute(space, row, source_ns, age_s, planned)

    def _agreed_space(self, label: str) -> ControlSpace:
        """The space of an action by its label. Raises InvalidInputError for one that this control
        does not execute.
        """
        name, rate_hz = split_label(label)
        space = self._spaces.get(name)
        if space is not None and rate_hz:
            space = replace(space, rate_hz=rate_hz)
        # the second: a rate that is none, or one of a space that has none
        if space is None or space.label != label:
            raise InvalidInputError(
                f"An action is labelled {label!r}; this control executes "
                f"{', '.join(map(repr, self._spaces))}."
            )
        if space.kind == "joint_velocity" and not rate_hz:
            raise InvalidInputError(
                f"An action is labelled {label!r}, which does not say how long a velocity is held; "
                "expected 'joint_velocity@<rows per second>:...'."
            )
        return space

    def _execute(
        self,
        space: ControlSpace,
        row: F64,
        source_ns: int,
        age_s: float,
        planned: messages.PlannedRows | None,
    ) -> None:
        joints = self.watched.joints
        if joints is None:  # excluded by `why_not`
            return
        now_s = time.monotonic()
        # the controller is told the time that the arm has
        step_s = self.step_s(source_ns, now_s)
        answer = self._compute(space, row, joints, step_s, now_s)
        if self.handover.is_shadow(source_ns):
            self.handover.withhold(answer)
            return
        outcome: JointCommand | Hold | None = answer
        if isinstance(outcome, JointCommand):
            outcome = self._limit(outcome, joints, now_s)
        self.status.set_value("compute_ms", (time.monotonic() - now_s) * 1e3)
        message = None
        if isinstance(outcome, JointCommand):
            message = self.to_message(outcome, self._plan(space, planned, outcome, joints))
        elif outcome is None and self._has_plan:
            # the arm must not go on to rows that were planned before this one was refused
            reason = "A row was refused; what was planned after the one before it is withdrawn."
            outcome = Hold(code="plan_withdrawn", reason=reason)
        took_s = time.monotonic() - now_s
        if message is not None and (late := self.why_not(age_s + took_s, source_ns)):
            # A slow controller, or a process that was frozen meanwhile: the command answers to what
            # is past. Checked last, because a process that is frozen after this check sends it when
            # it wakes up.
            outcome = Hold(
                code=late, reason=f"A command was ready only {took_s:.3g} s after its action."
            )
            self.limiter.rest(None, now_s)
        # refused: what was sent before comes to its end, and is then held by the watchdog
        if outcome is None:
            return
        self.action_s = now_s
        if isinstance(outcome, Hold):
            self.status.drop(outcome.code)
            self.hold(outcome.code, outcome.reason)
            return
        self._has_plan = isinstance(message, JointTrajectory) and len(message.points) > 1
        self.command.publish(message)
        self.handover.note_sent("command")
        self._is_sent = True
        self.note_command()
        self.status.output.tick()
        self.status.latency.append(age_s * 1e3)
        self.status.set_value("residual_m", outcome.residual_m)
        self.status.set_value("residual_rad", outcome.residual_rad)

    def _limit(
        self, command: JointCommand, joints: JointSample, now_s: float
    ) -> JointCommand | Hold | None:
        """What to send instead of `command`: itself, a shorter one, a reason to hold, or None for
        nothing.
        """
        limited = self.limiter.limit(command, joints, now_s)
        if limited.command is None:
            self.status.drop(f"limit_{limited.acted[-1]}")
        for tell in self.on_limited:
            tell(limited)
        return limited.command

    def _plan(
        self,
        space: ControlSpace,
        planned: messages.PlannedRows | None,
        command: JointCommand,
        joints: JointSample,
    ) -> list[JointCommand]:
        """Commands for the rows that are planned after that of `command`, each limited from where
        and when the one before ends.

        They end before the first row that cannot be executed, and within `horizon_s`. Each is
        computed and limited anew, and told, when its row is due. Only rows that say where to be are
        planned: a displacement or velocity counts from where the arm is measured when it is due,
        and would be executed twice.
        """
        if planned is None or not (self.section.horizon_s and space.is_absolute):
            return []
        # `_executed_spaces` has looked
        controller = cast("SpaceController", self._controller)
        commands, limiter = [command], self.limiter
        most_s = limiter.ends_s + self.section.horizon_s + _ROUNDING_S
        for row in planned.rows[:_MOST_PLANNED]:
            joints = _after(commands[-1], joints)
            answer = controller.execute(space, row, joints, planned.step_s)
            if isinstance(answer, Hold):
                break
            limiter = limiter.fork()
            limited = limiter.limit(answer, joints, limiter.ends_s).command
            is_sent = isinstance(limited, JointCommand) and limited.names == command.names
            if not is_sent or limiter.ends_s > most_s:
                break
            self.limiter.expect(limiter)
            commands.append(cast("JointCommand", limited))
        return commands[1:]

    def _compute(
        self, space: ControlSpace, row: F64, joints: JointSample, step_s: float, now_s: float
    ) -> JointCommand | Hold:
        """The controller's answer to one row."""
        if space.kind == EE_DELTA.kind:
            return self._controller.compute(Action.from_vector(row), joints, step_s)
        # `_executed_spaces` has looked
        controller = cast("SpaceController", self._controller)
        # A velocity holds for one period of the policy, whenever its message arrives. Positions
        # are to be reached by when the next row is due.
        if space.rate_hz:
            step_s = 1.0 / space.rate_hz
        answer = controller.execute(space, row, self.limiter.reference(joints, now_s), step_s)
        if space.rate_hz and isinstance(answer, JointCommand):
            # Its message came early, or the one before came late: what is left of that one is not
            # rushed, or the limits would cut off a part of a steady motion.
            more_s = _SHARE_OF_REST * self.limiter.remaining_s(now_s)
            answer = replace(answer, duration_s=answer.duration_s + more_s)
        return answer


def _after(command: JointCommand, joints: JointSample) -> JointSample:
    """The joints when `command` has come to its end."""
    ends = dict(zip(command.names, command.position.tolist(), strict=True))
    position = [
        ends.get(name, place)
        for name, place in zip(joints.names, joints.position.tolist(), strict=True)
    ]
    return replace(joints, position=np.array(position), velocity=None)


def _executed_spaces(
    spec: ControllerSpec, controller: Controller, profile: RobotProfile
) -> dict[str, ControlSpace]:
    """Spaces that control executes, by label. Raises ConfigurationError when the controller cannot
    do what its descriptor says.
    """
    # inference resolves `joint_delta`, which never travels; a 7-vector is for one arm
    never = {"joint_delta", *(("ee_delta",) if profile.arms else ())}
    kinds = [kind for kind in spec.spaces if kind not in never]
    if profile.arms and not (kinds and isinstance(controller, SeveralArms)):
        raise ConfigurationError(
            f"Controller {spec.name!r} moves one arm; robot {profile.name!r} has "
            f"{len(profile.arms)}.",
            hint="Choose a controller for several arms, such as 'urdf'.",
        )
    if kinds != ["ee_delta"] and not isinstance(controller, SpaceController):
        raise ConfigurationError(
            f"Controller {spec.name!r} declares {', '.join(kinds)}, but has no `execute`."
        )
    spaces = (robot_space(kind, profile) for kind in kinds)
    return {space.label: space for space in spaces}
