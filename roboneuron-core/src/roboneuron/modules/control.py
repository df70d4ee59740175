"""Control: actions and measured joints in, joint commands out; holds when actions stop or anything is doubtful."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import LifecyclePublisher
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from roboneuron.contract import Action, Controller, Hold, JointCommand, JointSample, RobotProfile
from roboneuron.errors import ConfigurationError, RoboNeuronError, UnsafeError
from roboneuron.gate.motion import collision_of
from roboneuron.modules.handover import Handover
from roboneuron.modules.joint_watch import JointWatch
from roboneuron.modules.module import Module, ModuleNode
from roboneuron.modules.motion import MotionGuard
from roboneuron.modules.plugin import build, load_profile
from roboneuron.modules.shadow_controller import ShadowController
from roboneuron.planning import check_plan
from roboneuron.plugins.discovery import discover
from roboneuron.ros.messages import (
    joints_from_message,
    to_joint_command_state,
    to_joint_trajectory,
    to_pose_stamped,
    vector_from_action_message,
)
from roboneuron.ros.qos import NEWEST
from roboneuron.ros.topics import ACTION, EE_POSE, JOINT_COMMAND, JOINT_STATES, JOINT_TRAJECTORY

_POSE_PERIOD_S = 0.02
_HOLD_DURATION_S = 0.05
_SHORTEST_STEP_S, _FIRST_STEP_S = 0.02, 0.1
_FUTURE_S = 0.1
"""How far the clock of another machine may be ahead of this one."""


class ControlModule(Module):
    """Executes actions one by one; everything happens in the executor's thread."""

    def __init__(self, node: ModuleNode) -> None:
        super().__init__(node)
        self._controller: Controller | None = None
        self._profile: RobotProfile | None = None
        self._command: LifecyclePublisher | None = None
        self._ee_pose: LifecyclePublisher | None = None
        self._timer: Any = None
        self._subscriptions: list[object] = []
        self._watched: JointWatch | None = None
        self._guard: MotionGuard | None = None
        self._handover = Handover()
        self._shadow: ShadowController | None = None
        self._told: set[str] = set()
        self._pose_s = 0.0
        self._action_s = 0.0
        self._action_ns = 0
        self._active = False
        self._holding = True
        self._hold_is_due = False

    def configure(self) -> None:
        """Parse the robot description and subscribe."""
        config = self.config.control
        if config is None:
            raise ConfigurationError("The configuration has no [control] section.")
        self._limits = config
        registry = discover(self.config.disabled_plugins)
        plan = check_plan(
            registry,
            robot=self.config.robot.name,
            driver=self.config.robot.driver,
            perception=None,
            controller=config.controller,
            backend=None,
            runtime=None,
            acceleration=None,
        )
        assert plan.controller is not None
        profile = load_profile(registry, self.config.robot.name)
        self._profile = replace(profile, collision=collision_of(self.config.limits, profile))
        options = self.config.options(plan.controller.name)
        self._controller = cast("Controller", build(plan.controller, options, self._profile))
        self._controller.load()
        self._watched = JointWatch(self._profile, config.state_timeout_s)
        self._guard = MotionGuard(
            self.config, self._profile, self._controller, self.status, Path(self.settings.state_directory)
        )
        self.status.set_value("controller", plan.controller.name)
        self._ee_pose = self.node.create_lifecycle_publisher(PoseStamped, EE_POSE, NEWEST)
        self._command = (
            self.node.create_lifecycle_publisher(JointTrajectory, JOINT_TRAJECTORY, NEWEST)
            if config.command == "joint_trajectory"
            else self.node.create_lifecycle_publisher(JointState, JOINT_COMMAND, NEWEST)
        )
        self._subscriptions = [
            self.node.create_subscription(JointState, JOINT_STATES, self._on_joint_state, NEWEST),
            self.node.create_subscription(Float64MultiArray, ACTION, self._on_action, NEWEST),
        ]
        self._handover.serve(self.node, shadow=self.settings.shadow)
        if self.settings.shadow:
            self._shadow = ShadowController(
                self.node, self.status, config.command, self._controller.forward, self._on_predecessor
            )
        self._timer = self.node.create_timer(config.action_timeout_s / 5, self._watch)

    def activate(self) -> None:
        """Ready once a joint state has been turned into a TCP pose."""
        self.status.set_waiting(f"joint states on {JOINT_STATES} (is the robot running?)")
        self._holding = True
        self._hold_is_due = False
        self._active = True

    def deactivate(self) -> None:
        """Hold, then stop commanding."""
        if self._active:
            self._hold("deactivated", "Control was deactivated.")
        self._active = False

    def close(self) -> None:
        """Release the controller and the topics."""
        self._active = False
        if self._timer is not None:
            self.node.destroy_timer(self._timer)
            self._timer = None
        for subscription in self._subscriptions:
            self.node.destroy_subscription(subscription)
        self._subscriptions.clear()
        if self._shadow is not None:
            self._shadow.close()
            self._shadow = None
        for publisher in (self._command, self._ee_pose):
            if publisher is not None:
                self.node.destroy_lifecycle_publisher(publisher)
        self._command = self._ee_pose = None
        if self._guard is not None:
            self._guard.close()
        if self._controller is not None:
            self._controller.close()
        self._controller = self._guard = self._watched = None

    def emergency_stop(self, latched: bool) -> None:
        """Hold as long as the latch is set."""
        if latched and self._active:
            self._hold("emergency_stop", "The emergency stop is latched.")

    @property
    def _joints(self) -> JointSample | None:
        """Newest joint state that was believed."""
        return None if self._watched is None else self._watched.joints

    def _on_joint_state(self, message: JointState) -> None:
        if self._watched is None:
            return
        now_s = time.monotonic()
        try:
            joints = joints_from_message(message)
            is_new = self._watched.accept(joints, now_s, int(self.node.get_clock().now().nanoseconds))
            if is_new and self._shadow is not None:
                self._shadow.see(joints)
            if is_new and self._active and self._hold_is_due:
                self._command_hold(joints)
            if is_new and self._active and now_s - self._pose_s >= _POSE_PERIOD_S:
                self._publish_pose(joints)
                self._pose_s = now_s
        except RoboNeuronError as error:
            self.status.dropped.add("bad_joint_state")
            self.status.set_error(error)

    def _publish_pose(self, joints: JointSample) -> None:
        assert self._controller is not None
        assert self._ee_pose is not None
        assert self._profile is not None
        pose = self._controller.forward(joints)
        if self._handover.is_ours(joints.stamp_ns):
            self._ee_pose.publish(to_pose_stamped(pose, self._profile.base_link))
            self._tell("pose")
        self.status.clear_error()
        self.status.set_ready()

    def _on_action(self, message: Float64MultiArray, info: dict[str, Any]) -> None:
        if not self._active or self._handover.is_over(int(info["source_timestamp"])):
            return
        age_s = (time.time_ns() - int(info["source_timestamp"])) / 1e9
        reason = self._why_not(age_s, int(info["source_timestamp"]))
        if reason is not None:
            self.status.dropped.add(reason)
            return
        try:
            action = Action.from_vector(vector_from_action_message(message))
        except RoboNeuronError as error:
            self.status.dropped.add("non_finite" if isinstance(error, UnsafeError) else "malformed")
            self.status.set_error(error)
            return
        self._execute(action, int(info["source_timestamp"]), age_s)

    def _why_not(self, age_s: float, source_ns: int) -> str | None:
        """Word for what forbids acting now, or None."""
        if self.node.stopped:
            return "emergency_stop"
        if self._is_server_silent():
            return "server_silent"
        if age_s > self._limits.action_timeout_s:
            return "stale_action"
        if age_s < -_FUTURE_S:
            return "future_action"
        if source_ns < self._action_ns <= time.time_ns() + _FUTURE_S * 1e9:  # else the clock was set back since
            return "reordered_action"
        if self._are_joints_stale():
            return "stale_joint_state"
        return None

    def _is_server_silent(self) -> bool:
        """Nobody could stop the arm from outside: the server is frozen."""
        return self.node.server_silence_s() > self._limits.server_timeout_s

    def _are_joints_stale(self) -> bool:
        return self._watched is None or self._watched.age_s(time.monotonic()) > self._limits.state_timeout_s

    def _execute(self, action: Action, source_ns: int, age_s: float) -> None:
        joints = self._joints
        assert self._controller is not None
        assert self._guard is not None
        assert joints is not None
        now_s = time.monotonic()
        since_s = now_s - self._action_s
        step_s = max(since_s, _SHORTEST_STEP_S) if since_s < self._limits.action_timeout_s else _FIRST_STEP_S
        self._action_ns = source_ns
        answer = self._controller.compute(action, joints, step_s)
        if self._handover.is_shadow(source_ns):
            if self._shadow is not None:
                self._shadow.answer(answer)
            return
        outcome: JointCommand | Hold | None = answer
        if isinstance(outcome, JointCommand):
            outcome = self._guard.judge(outcome, joints, now_s)
        self.status.set_value("compute_ms", (time.monotonic() - now_s) * 1e3)
        if outcome is None:  # refused: what was sent before comes to its end, and is then held by the watchdog
            return
        self._action_s = now_s
        if isinstance(outcome, Hold):
            self.status.dropped.add(outcome.code)
            self._hold(outcome.code, outcome.reason)
            return
        self._send(outcome)
        self._tell("command")
        self._holding = self._hold_is_due = False
        self.status.output.tick()
        self.status.latency.add(age_s * 1e3)
        self.status.set(note="following actions")
        self.status.set_value("residual_m", outcome.residual_m)
        self.status.set_value("residual_rad", outcome.residual_rad)

    def _watch(self) -> None:
        """Hold within one timeout after the last action."""
        if not self._active or self._holding or not self._is_ours_now():
            return
        if self._is_server_silent():
            self._hold("server_silent", f"No sign of life of the server for {self._limits.server_timeout_s:g} s.")
        elif time.monotonic() - self._action_s > self._limits.action_timeout_s * 0.75:
            self._hold("no_action", f"No action for {self._limits.action_timeout_s:g} s.")
        elif self._are_joints_stale():
            self._hold("stale_joint_state", f"No joint state for {self._limits.state_timeout_s:g} s.")

    def _hold(self, code: str, reason: str) -> None:
        """Command the measured posture, once per reason to hold.

        Without a fresh one nothing is sent: the arm would go back to where it was. Its last command comes to an end,
        and the next joint state is held at once. In shadow the arm is left to the other control.
        """
        if not self._is_ours_now():
            return
        self.status.set(note=f"holding: {reason}")
        self.status.set_value("hold_code", code)
        if self._holding:
            return
        self._holding = True
        self.status.dropped.add("holds")
        joints = self._joints
        if joints is None or self._are_joints_stale():
            self._hold_is_due = True
            return
        self._command_hold(joints)

    def _is_ours_now(self) -> bool:
        return self._handover.is_ours(time.time_ns())

    def _on_predecessor(self, command: JointCommand, sent_s: float) -> None:
        """Go on from where the arm was sent by the control before this one."""
        joints = self._joints
        if "command" in self._told or joints is None or self._guard is None:
            return
        self._guard.follow(command, joints, sent_s)
        self._action_s, self._holding = sent_s, False

    def _tell(self, what: str) -> None:
        """Tell when the first and the newest of its kind went out: a change-over is confirmed and measured by that."""
        now_ns = time.time_ns()
        self.status.set_value(f"last_sent_ns.{what}", now_ns)
        if what not in self._told:
            self._told.add(what)
            self.status.set_value(f"first_sent_ns.{what}", now_ns)
            self.status.changed.set()

    def _command_hold(self, joints: JointSample) -> None:
        assert self._profile is not None
        assert self._guard is not None
        self._hold_is_due = False
        index = [joints.names.index(name) for name in self._profile.arm_joints]
        self._send(
            JointCommand(names=self._profile.arm_joints, position=joints.position[index], duration_s=_HOLD_DURATION_S)
        )
        self._guard.rest(joints, time.monotonic())

    def _send(self, command: JointCommand) -> None:
        assert self._command is not None
        if self._limits.command == "joint_trajectory":
            self._command.publish(to_joint_trajectory(command))
        else:
            self._command.publish(to_joint_command_state(command, int(self.node.get_clock().now().nanoseconds)))
