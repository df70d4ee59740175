"""The watchdogs and limits of what commands an arm: which inputs it may act on, and when it holds
instead.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from roboneuron.config import LimitsConfig
from roboneuron.config.models import FIRST_STEP_S
from roboneuron.contract import Controller, JointCommand, JointSample
from roboneuron.errors import ConfigurationError
from roboneuron.gate.motion import (
    MotionLimiter,
    MotionRules,
    check_tighter,
    collision_of,
    motion_rules,
    poses_of,
)
from roboneuron.gate.motion.command import pick
from roboneuron.modules.joint_watch import JointWatch
from roboneuron.modules.module_host import Module, ModuleHost
from roboneuron.modules.plugin import load_profile
from roboneuron.modules.settings import (
    FOLLOWING_NOTE,
    FUTURE_S,
    HOLD_DURATION_S,
    NEEDS_NEW_START,
    SERVER_SILENT,
)
from roboneuron.ros.messages import to_joint_state, to_joint_trajectory
from roboneuron.ros.topics import JOINT_COMMAND, JOINT_STATES, JOINT_TRAJECTORY


class HoldingModule(Module):
    """Commands an arm, and holds it when actions or joint states stop, the server is silent, or a
    stop has come. Everything happens in the executor's thread.

    A subclass turns actions into commands: it asks `why_not` before each, passes it to `limiter`,
    and tells `note_command` after it.

    Attributes:
        section: [control] of the configuration.
        profile: of the robot.
        command: publishes its commands.
        limiter: what every command passes; from `limit_with` on.
        poses: of the TCP of each arm, from joints; from `limit_with` on.
        watched: the newest joint state that is believed.
        is_active: commands may be sent.
        is_holding: the newest command was a hold.
        action_s, action_ns: the newest action: when it was acted on [monotonic s], and when it was
            sent [ROS time, ns].
    """

    limiter: MotionLimiter

    def __init__(self, node: ModuleHost) -> None:
        """Begin to watch.

        Raises:
            ConfigurationError: there is no [control] section, or no such robot.
        """
        super().__init__(node)
        if self.config.control is None:
            raise ConfigurationError("The configuration has no [control] section.")
        self.section = self.config.control
        profile = load_profile(self.registry, self.config.robot.name)
        self.profile = replace(profile, collision=collision_of(self.config.limits, profile))
        self.watched = JointWatch(self.profile, self.section.state_timeout_s)
        self.action_s = 0.0
        self.action_ns = 0
        self.is_active = False
        self.is_holding = True
        # there was no joint state to hold at: the next one is held
        self._hold_is_due = False
        is_state = self.section.command == "joint_state"
        commands = (JointState, JOINT_COMMAND) if is_state else (JointTrajectory, JOINT_TRAJECTORY)
        self.command = node.advertise(*commands)
        node.repeat(self.section.action_timeout_s / 5, self._watch)

    def limit_with(self, controller: Controller) -> None:
        """Make `limiter`, which asks this controller for poses and distances.

        Raises:
            ConfigurationError: as `check_limits`.
        """
        self.limiter = MotionLimiter.of(
            self.check_limits(self.node.settings.tightened or self.config.limits),
            self.profile,
            controller,
            immediate=self.section.command == "joint_state",
            # a longer command would outlive a frozen control
            longest_s=self.config.robot.server_timeout_s,
        )
        self.poses = poses_of(controller)

    def check_limits(self, limits: LimitsConfig) -> MotionRules:
        """What limits mean for this robot.

        Raises:
            ConfigurationError: they do not fit the robot, or are wider than the configured ones.
        """
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
        self._hold_if_active("deactivated", "Control was deactivated.")
        self.is_active = False

    def emergency_stop(self, latched: bool) -> None:
        """Hold as long as the latch is set."""
        if latched:
            self._hold_if_active("emergency_stop", "The emergency stop is latched.")

    def forget(self) -> None:
        """Hold; see `Module.forget`. Actions are dropped until somebody asks for motion."""
        self._hold_if_active(
            NEEDS_NEW_START, f"Motion needs a new start after a stop: {self.node.needs_start}."
        )

    def believe(self, joints: JointSample, now_s: float) -> bool:
        """Take a joint state; whether it is a new one that matters. Raises as `JointWatch.accept`.

        Args:
            joints: as received.
            now_s: monotonic time.
        """
        if not self.watched.accept(joints, now_s, self.node.now_ns()) or not self.is_active:
            return False
        if self._hold_is_due:
            self._command_hold(joints)
        return True

    def why_not(self, age_s: float, source_ns: int) -> str | None:
        """Word for what forbids acting now, or None.

        Args:
            age_s: of the action, since it was sent [s].
            source_ns: when it was sent [ns].
        """
        if self.node.stopped:
            return "emergency_stop"
        if self._is_server_silent():
            return "server_silent"
        if self.node.needs_start:
            return NEEDS_NEW_START
        if age_s > self.section.action_timeout_s:
            return "stale_action"
        if age_s < -FUTURE_S:
            return "future_action"
        # else the clock was set back since
        if source_ns < self.action_ns <= time.time_ns() + FUTURE_S * 1e9:
            return "reordered_action"
        if self._are_joints_stale():
            return "stale_joint_state"
        return None

    def step_s(self, source_ns: int, now_s: float) -> float:
        """Time that the arm has for an action that was sent then: that since the one before [s].

        By sending and by arrival: actions that were held up arrive together, and were not meant to
        follow each other.
        """
        spacing_s = (source_ns - self.action_ns) / 1e9 if self.action_ns else 0.0
        self.action_ns = source_ns
        return self.section.step_s(max(now_s - self.action_s, min(spacing_s, FIRST_STEP_S)))

    def note_command(self) -> None:
        """A command that is no hold has gone out."""
        self.status.set(note=FOLLOWING_NOTE)
        if self.is_holding:
            self.status.changed.set()  # at once: from now on a hold will come
        self.is_holding = self._hold_is_due = False

    def hold(self, code: str, reason: str) -> None:
        """Command the measured posture, once per reason to hold.

        Without a fresh one nothing is sent: the arm would go back to where it was. Its last command
        comes to an end, and the next joint state is held at once. In shadow the arm is left to the
        other control.
        """
        if not self._is_ours_now():
            return
        self.status.set(note=f"holding: {reason}")
        self.status.set_value("hold_code", code)
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

    def to_message(
        self, command: JointCommand, planned: Sequence[JointCommand] = ()
    ) -> JointTrajectory | JointState:
        """A command, and what is planned after it, as the configured type of message; a JointState
        carries no duration and no plan.
        """
        if self.section.command == "joint_trajectory":
            return to_joint_trajectory(command, *planned)
        return to_joint_state(
            JointSample(names=command.names, position=command.position, stamp_ns=self.node.now_ns())
        )

    def _watch(self) -> None:
        """Hold within one timeout after the last action.

        It looks five times per timeout, and holds after three quarters of it: so the arm has
        begun to hold before the timeout is over.
        """
        if not self.is_active or self.is_holding or not self._is_ours_now():
            return
        if self._is_server_silent():
            if not self.node.needs_start:
                self.node.require_start(SERVER_SILENT)
            self.hold(
                "server_silent",
                f"No sign of life of the server for {self.section.server_timeout_s:g} s.",
            )
        elif time.monotonic() - self.action_s > self.section.hold_after_s:
            self.hold("no_action", f"No action for {self.section.action_timeout_s:g} s.")
        elif self._are_joints_stale():
            self.hold(
                "stale_joint_state", f"No joint state for {self.section.state_timeout_s:g} s."
            )

    def _hold_if_active(self, code: str, reason: str) -> None:
        if self.is_active:
            self.hold(code, reason)

    def _command_hold(self, joints: JointSample) -> None:
        """Command the arm to stay where it is measured; the limiter starts anew from there.

        The gripper is not commanded: it keeps what it holds.
        """
        self._hold_is_due = False
        arm = self.profile.arm_joints
        position = pick(joints.names, joints.position, arm)
        self.command.publish(
            self.to_message(JointCommand(names=arm, position=position, duration_s=HOLD_DURATION_S))
        )
        self.limiter.rest(joints, time.monotonic())

    def _is_server_silent(self) -> bool:
        """Nobody could stop the arm from outside: the server is frozen."""
        return self.node.server_silence_s() > self.section.server_timeout_s

    def _are_joints_stale(self) -> bool:
        return self.watched.age_s(time.monotonic()) > self.section.state_timeout_s

    def _is_ours_now(self) -> bool:
        return self.handover.is_ours(time.time_ns())
