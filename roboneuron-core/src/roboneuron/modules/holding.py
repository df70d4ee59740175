"""Watchdogs and limits of a module that commands an arm, and its only access to the joints: which
inputs are valid, what is sent for them, and when the arm holds.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import final

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from roboneuron.config import LimitsConfig
from roboneuron.config.models import FIRST_STEP_S
from roboneuron.contract import Controller, Hold, JointCommand, JointSample
from roboneuron.errors import ConfigurationError, RoboNeuronError, UnsafeError
from roboneuron.gate.motion import (
    MotionLimiter,
    MotionRules,
    check_tighter,
    collision_of,
    motion_rules,
    poses_of,
)
from roboneuron.gate.motion.command import Asked, pick
from roboneuron.modules.joint_watch import JointWatch
from roboneuron.modules.module_host import LimitedModule, ModuleHost
from roboneuron.modules.plugin import load_profile
from roboneuron.modules.settings import (
    FOLLOWING_NOTE,
    FUTURE_S,
    HOLD_DURATION_S,
    HOLDING_NOTE,
)
from roboneuron.moved import Moved
from roboneuron.ros.graph import server_node
from roboneuron.ros.messages import commands_from_message, to_joint_state, to_joint_trajectory
from roboneuron.ros.topics import JOINT_COMMAND, JOINT_STATES, JOINT_TRAJECTORY


class HoldingModule(LimitedModule):
    """Base of modules that command an arm; holds it when actions or joint states stop, the server
    is silent, or a stop has come. Runs on the executor's thread.

    A subclass calls `act` with the target of each of its inputs. There is no other access to the
    joints: only this class sends commands, within the limits, and never while the arm must hold.

    Attributes:
        section: [control] of the configuration.
        profile: the robot's profile.
        poses: computes the TCP poses of each arm from joints; from `limit_with` on.
        reference, remaining_s: of the command in progress, see `MotionLimiter`; from `limit_with`
            on.
        watched: the newest accepted joint state.
        clock: the arm's time [s], by which steps and set points are counted; watchdogs and ages go
            by the real one. A filter may set another one.
        fixed_step_s: time of each action [s]; None for the time since the previous one.
        is_active: commands may be sent.
        is_holding: the newest command was a hold.
        action_s, action_ns: the newest action: when it was acted on [monotonic s], and when it was
            sent [ROS time, ns].
    """

    on_limited = Moved("StepFilter.note_limited")
    _limiter: MotionLimiter

    def __init__(self, node: ModuleHost) -> None:
        """Start the watchdogs.

        Raises:
            ConfigurationError: there is no [control] section, or no such robot.
        """
        super().__init__(node)
        if self.config.control is None:
            raise ConfigurationError("The configuration has no [control] section.")
        self.section = self.config.control
        profile = load_profile(self.registry, self.config.robot)
        self.profile = replace(profile, collision=collision_of(self.config.limits, profile))
        self.watched = JointWatch(self.profile, self.section.state_timeout_s)
        self.clock: Callable[[], float] = time.monotonic
        self.fixed_step_s: float | None = None
        self.action_s = 0.0
        self.action_ns = 0
        self.is_active = False
        self.is_holding = True
        # there was no joint state to hold at: the next one is held
        self._hold_is_due = False
        self._hold_code = ""
        # a command of this process was sent: from then on the predecessor's are ignored
        self._is_sent = False
        self._server = server_node(os.getppid())
        # the newest command continues by itself after its row
        self._has_plan = False
        is_state = self.section.command == "joint_state"
        commands = (JointState, JOINT_COMMAND) if is_state else (JointTrajectory, JOINT_TRAJECTORY)
        self._commands = node.advertise(*commands)
        node.repeat(self.section.action_timeout_s / 5, self._watch)

    def limit_with(self, controller: Controller) -> None:
        """Apply the limits from now on, with the poses and distances computed by this controller.

        Raises:
            ConfigurationError: see `check_limits`.
        """
        self._limiter = MotionLimiter.of(
            self.check_limits(self.limits_at_start),
            self.profile,
            controller,
            immediate=self.section.command == "joint_state",
            # a longer command would outlive a frozen control
            longest_s=self.config.robot.server_timeout_s,
        )
        self.offer_limits()
        self.poses = poses_of(controller)
        self.reference = self._limiter.reference
        self.remaining_s = self._limiter.remaining_s

    def use_limits(self, limits: LimitsConfig) -> None:
        """See `LimitedModule.use_limits`."""
        self._limiter.use(self.check_limits(limits))

    def check_limits(self, limits: LimitsConfig) -> MotionRules:
        """See `LimitedModule.check_limits`; returns the motion rules of this robot."""
        check_tighter(limits, self.config.limits)
        return motion_rules(limits, self.profile)

    def activate(self) -> None:
        """Hold until the first action."""
        self.status.set_waiting(f"joint states on {JOINT_STATES} (is the robot running?)")
        self.is_holding = True
        self._hold_is_due = False
        self.is_active = True

    def deactivate(self) -> None:
        """Hold, then stop commanding."""
        self.hold("deactivated", "Control was deactivated.")
        self.is_active = False

    def stop(self, code: str) -> None:
        """Hold; see `Module.stop`. Actions are dropped until motion is requested."""
        self.hold(code, f"Motion needs a new start after a stop: {self.node.needs_start}.")

    def believe(self, joints: JointSample, now_s: float) -> bool:
        """Accept a joint state; return True if it is new and relevant. Raises as
        `JointWatch.accept`.

        Args:
            joints: as received.
            now_s: monotonic time.
        """
        if not self.watched.accept(joints, now_s, self.node.now_ns()) or not self.is_active:
            return False
        if self._hold_is_due:
            self._command_hold(joints)
        return True

    def follow(self, message: JointTrajectory | JointState, sent_s: float) -> JointCommand:
        """Continue from a command of the previous control process.

        Args:
            message: as that control has published it.
            sent_s: time of sending [monotonic s].

        Returns:
            The command.

        Raises:
            InvalidInputError: it is malformed.
        """
        command = commands_from_message(message)[0]
        joints = self.watched.joints
        if not self._is_sent and joints is not None:
            self._limiter.follow(command, joints, sent_s)
            self.action_s, self.is_holding = sent_s, False
        return command

    @final
    def act(self, source_ns: int, read: Callable[[], Asked]) -> None:
        """Execute an action within the limits, or count the reason for dropping it.

        Args:
            source_ns: time at which it was sent [ROS time, ns].
            read: called if it may be acted on; if it raises RoboNeuronError, the error is reported
                and the action dropped.
        """
        if not self.is_active or not self.filters.admits(source_ns):
            return
        age_s = (time.time_ns() - source_ns) / 1e9
        reason = self.why_not(age_s, source_ns)
        if reason is not None:
            self.status.drop(reason)
            return
        try:
            asked = read()
        except RoboNeuronError as error:
            self.status.drop("non_finite" if isinstance(error, UnsafeError) else "malformed")
            self.status.set_error(error)
            return
        self._execute(asked, source_ns, age_s)

    def _execute(self, asked: Asked, source_ns: int, age_s: float) -> None:
        joints = self.watched.joints
        if joints is None:  # excluded by `why_not`
            return
        began_s = time.monotonic()
        now_s = self.clock()
        wanted = asked.now(joints, self.step_s(source_ns, began_s), now_s)
        if not self.filters.sends(source_ns):
            self.filters.withhold(wanted)
            return
        outcome: JointCommand | Hold | None = wanted
        if isinstance(outcome, JointCommand):
            outcome = self._limit(outcome, joints, now_s)
        self.status.set_value("compute_ms", (time.monotonic() - began_s) * 1e3)
        message = None
        if isinstance(outcome, JointCommand):
            planned = self._limiter.plan(
                outcome, joints, asked.later, asked.step_s, self.section.horizon_s
            )
            message = self._to_message(outcome, planned)
        elif outcome is None and self._has_plan:
            # the arm must not go on to rows that were planned before this one was refused
            reason = "A row was refused; what was planned after the one before it is withdrawn."
            outcome = Hold(code="plan_withdrawn", reason=reason)
        took_s = time.monotonic() - began_s
        if message is not None and (late := self.why_not(age_s + took_s, source_ns)):
            # A slow controller, or a process that was frozen meanwhile: the command is outdated.
            # Checked last, because a process that is frozen after this check sends the command when
            # it resumes.
            outcome = Hold(
                code=late, reason=f"A command was ready only {took_s:.3g} s after its action."
            )
            self._limiter.rest(None, now_s)
        # refused: the previous command comes to its end, then the watchdog holds
        if outcome is None:
            return
        self.action_s = began_s
        if isinstance(outcome, Hold):
            self.status.drop(outcome.code)
            self.hold(outcome.code, outcome.reason)
            return
        self._has_plan = isinstance(message, JointTrajectory) and len(message.points) > 1
        self._commands.publish(message)
        self.filters.note_sent("command")
        self._note_command()
        self.status.output.tick()
        self.status.latency.append(age_s * 1e3)
        self.status.set_value("residual_m", outcome.residual_m)
        self.status.set_value("residual_rad", outcome.residual_rad)

    def _limit(
        self, command: JointCommand, joints: JointSample, now_s: float
    ) -> JointCommand | Hold | None:
        """Apply the limits to `command`: returns it, a shorter command, a reason to hold, or None
        for nothing to send.
        """
        limited = self._limiter.limit(command, joints, now_s)
        if limited.command is None:
            self.status.drop(f"limit_{limited.acted[-1]}")
        for one in self.filters:
            one.note_limited(limited)
        return limited.command

    @final
    def why_not(self, age_s: float, source_ns: int) -> str | None:
        """Reason that forbids acting now, or None.

        Args:
            age_s: time since the action was sent [s].
            source_ns: time at which it was sent [ns].
        """
        if word := self.why_stopped():
            return word
        if age_s > self.section.action_timeout_s:
            return "stale_action"
        if age_s < -FUTURE_S:
            return "future_action"
        # otherwise the clock was set back since
        if source_ns < self.action_ns <= time.time_ns() + FUTURE_S * 1e9:
            return "reordered_action"
        if self._are_joints_stale():
            return "stale_joint_state"
        return None

    def step_s(self, source_ns: int, now_s: float) -> float:
        """Time available for an action: the time since the previous one [s].

        The larger of the intervals by sending (bounded) and by arrival: delayed actions arrive
        together, but were not meant to follow each other at once.

        Args:
            source_ns: time at which the action was sent [ROS time, ns].
            now_s: monotonic time.
        """
        spacing_s = (source_ns - self.action_ns) / 1e9 if self.action_ns else 0.0
        self.action_ns = source_ns
        if self.fixed_step_s is not None:
            return self.fixed_step_s
        return self.section.step_s(max(now_s - self.action_s, min(spacing_s, FIRST_STEP_S)))

    def _note_command(self) -> None:
        """Record that a command other than a hold was sent."""
        self._is_sent = True
        self.status.set(note=FOLLOWING_NOTE)
        if self.is_holding:
            self.status.changed.set()  # at once: from now on a hold will come
        self.is_holding = self._hold_is_due = False

    def hold(self, code: str, reason: str) -> None:
        """Command the measured posture, once per reason to hold.

        Without a fresh joint state nothing is sent, since the arm would return to an old posture:
        its last command comes to an end, and the next joint state is held at once. A control whose
        filters send nothing, or that is inactive, sends no hold either.
        """
        if not self.is_active or not self.filters.is_ours(time.time_ns()):
            return
        self.status.set(note=f"{HOLDING_NOTE}{reason}")
        self.status.set_value("hold_code", code)
        self._hold_code = code
        if self.is_holding:
            return
        # before it is sent: a hold that is due is not sent twice
        self.is_holding = True
        self.status.drop("holds")
        joints = self.watched.joints
        if joints is None or self._are_joints_stale():
            self._hold_is_due = True
        else:
            self._command_hold(joints)
        self.status.changed.set()

    def _to_message(
        self, command: JointCommand, planned: Sequence[JointCommand] = ()
    ) -> JointTrajectory | JointState:
        """Convert a command and the commands planned after it to the configured message type; a
        JointState has no duration and no plan.
        """
        message: JointTrajectory | JointState
        if self.section.command == "joint_trajectory":
            message = to_joint_trajectory(command, *planned)
        else:
            joints = JointSample(
                names=command.names, position=command.position, stamp_ns=self.node.now_ns()
            )
            message = to_joint_state(joints)
        message.header.frame_id = self._server
        return message

    def _watch(self) -> None:
        """Hold within one timeout after the last action.

        The check runs five times per timeout and holds after three quarters of it, so the arm has
        begun to hold before the timeout is over. A robot that is lost is named rather than the
        actions, because these are refused without it.
        """
        if not self.is_active or not self.filters.is_ours(time.time_ns()):
            return
        if self.is_holding and self._hold_code != "no_action":
            return
        if self._are_joints_stale():
            self.hold(
                "stale_joint_state", f"No joint state for {self.section.state_timeout_s:g} s."
            )
        elif not self.is_holding and (time.monotonic() - self.action_s > self.section.hold_after_s):
            self.hold("no_action", f"No action for {self.section.action_timeout_s:g} s.")

    def _command_hold(self, joints: JointSample) -> None:
        """Command the arm to stay at its measured posture; the limiter restarts from there.

        The gripper is not commanded: it keeps its grasp.
        """
        self._hold_is_due = False
        arm = self.profile.arm_joints
        position = pick(joints.names, joints.position, arm)
        command = JointCommand(names=arm, position=position, duration_s=HOLD_DURATION_S)
        self._commands.publish(self._to_message(command))
        self._limiter.rest(joints, self.clock())

    def _are_joints_stale(self) -> bool:
        return self.watched.age_s(time.monotonic()) > self.section.state_timeout_s
