"""The driver `ros2-control`: sends joint commands to a joint_trajectory_controller, and reports its
states and faults as the robot's.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rn_driver_ros2control.command import checked
from rn_driver_ros2control.faults import FAULTS, violation, worded
from rn_driver_ros2control.gripper import GripperGoals
from rn_driver_ros2control.link import ControllerLink, End
from rn_driver_ros2control.options import Ros2ControlOptions
from rn_driver_ros2control.trajectory import rows_within, shortest_s, stop_point, to_message
from rn_driver_ros2control.watch import ControllerWatch
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    JointCommand,
    JointLimits,
    MissingDependencyError,
    NotReadyError,
    RefusedError,
    RobotProfile,
    RobotState,
    StateError,
    Topics,
    UnsafeError,
    install_command,
)

F64 = NDArray[np.float64]
_ROUNDING_S = 1e-6
"""Tolerance for a horizon that is a whole number of targets."""
_SETTLE_S = 0.05
"""Time from sending until the controller's reports refer to the new command."""


class Ros2ControlDriver:
    """Implements `RobotDriver` and `LookaheadDriver`, and supports `recover`; every method may be
    called from any thread.

    The controller keeps the arm in position: it interpolates, holds its last point when commands
    cease or this process dies, and checks its own tolerances. A fault it reports is stored here
    until the robot is stopped and started again.
    """

    def __init__(
        self, config: Ros2ControlOptions | None, profile: RobotProfile, topics: Topics
    ) -> None:
        """Store the configuration."""
        self._options = config or Ros2ControlOptions()
        self._profile = profile
        self._topics = topics
        self._lock = threading.RLock()
        self._link: ControllerLink | None = None
        self._goal = 0
        self._goal_note = "none"
        self._end: End | None = None
        self._own_cancel = False
        self._fault = ""
        # target of the newest command, and the final target and its time [monotonic s] without
        # another command: the end of the planned commands
        self._place: F64 | None = None
        self._target: tuple[F64, float] | None = None
        self._sent_s = 0.0
        self._fingers = GripperGoals(profile.gripper)
        self._watch = ControllerWatch(self._options, profile, topics)

    def open(self) -> None:
        """Find the controller, its states and the gripper; nothing moves.

        Raises:
            ConfigurationError: the controller moves other joints, the profile is not an arm, or
                another node publishes the robot's own `joint_states`.
            NotReadyError: controller, joint states or gripper are missing, or the controller is not
                active.
            MissingDependencyError: control_msgs is not installed.
            StateError: it is open already.
        """
        if self._link is not None:
            raise StateError("The connection to ros2_control is open already.")
        if self._profile.limits is None or not self._profile.arm_joints:
            raise ConfigurationError(
                f"The robot {self._profile.name!r} has no arm; ros2-control moves arms."
            )
        link = self._connect()
        try:
            link.open(self)
            self._link = link
            self._watch.await_states(link)
            self._watch.check_topics()
        except BaseException:
            self._link = None
            link.close()
            raise
        self._fault, self._goal_note = "", "none"
        self._place = self._target = None
        self._fingers = GripperGoals(self._profile.gripper)

    def _connect(self) -> ControllerLink:
        """Create the link; tests override this."""
        try:
            from rn_driver_ros2control.ros_forward_link import RosForwardLink  # heavy
            from rn_driver_ros2control.ros_link import RosControllerLink
        except ModuleNotFoundError as error:
            if error.name is None or not error.name.startswith("control_msgs"):
                raise
            raise MissingDependencyError(
                "The ROS 2 types of ros2_control are not installed (package control_msgs).",
                hint=f"Run: {install_command('rn-driver-ros2control')}. It compiles them.",
            ) from error
        is_forward = self._options.controller_type == "forward-position"
        link = RosForwardLink if is_forward else RosControllerLink
        return link(self._options, self._profile.arm_joints)

    def read(self) -> RobotState:
        """Return the newest measured state.

        `detail` contains "controller" (active, inactive, absent, not watched), "mode", "goal"
        (result of the newest), "fault" (empty for none), "following_error" (greatest, rad or m),
        "speed_scaling", "gripper", and "no_gripper" with the option gripper none.

        Raises:
            StateError: not open.
            NotReadyError: the joint states have ceased.
            UnsafeError: a measured value is not finite.
        """
        link = self._opened()
        measured = link.joints()
        self._judge(link)
        self._watch.check_read(link, measured, self._fault)
        note = (
            "not driven: option gripper is none"
            if self._options.gripper == "none"
            else link.gripper_note()
        )
        told = {
            "mode": self._options.mode,
            "goal": self._goal_note,
            "fault": self._fault,
            "gripper": note,
        }
        if self._options.gripper == "none":
            told["no_gripper"] = "true"
        return self._watch.state(link, measured, told)

    def send(self, command: JointCommand) -> JointCommand:
        """Move towards `command`; it replaces the previous one. Missing arm joints keep their
        targets.

        Returns:
            The sent command: positions within the limits, the duration that they allow, and no
            gripper joint if the options drive none.

        Raises:
            InvalidInputError: unknown joints, unequal lengths, no duration, a value that is not
                finite, or a goal that the controller rejects; nothing moves.
            NotReadyError: states have ceased, or the controller is absent, inactive or does not
                answer.
            UnsafeError: there is a fault; see `recover`.
            StateError: not open.
        """
        return self.send_ahead(command, ())

    def send_ahead(self, command: JointCommand, planned: Sequence[JointCommand]) -> JointCommand:
        """As `send`; in mode chunks the controller continues with `planned`, within `horizon_s`.

        The gripper moves when its command is due.

        Raises:
            As `send`.
        """
        link = self._opened()
        wanted = checked(command, self._profile)
        later = [checked(one, self._profile) for one in planned]
        if self._fault and self._options.resume_after_fault:
            self._forget_fault()
        measured = link.joints()
        self._judge(link)
        if self._fault:
            raise UnsafeError(
                f"{self._options.controller}: {self._fault}. Commands are refused until a person "
                "has looked.",
                hint="When the cause is gone, call recover_robot, or stop and start the robot.",
            )
        self._watch.check_fresh(measured)
        self._watch.check_controller(link)
        arm = [name for name in command.names if name in self._profile.arm_joints]
        sent_s = command.duration_s
        if arm:
            with self._lock:
                names, limits = self._profile.arm_joints, self._limits()
                rest = np.array([measured[name].position for name in names])
                if self._place is not None:
                    rest = self._profile.kinds.span(names).nearest(rest, self._place)
                asked = [
                    wanted.get(name, float(place)) for name, place in zip(names, rest, strict=True)
                ]
                goal = np.clip(np.array(asked), limits.lower, limits.upper)
                rows = [(goal, command.duration_s)]
                if self._options.mode == "chunks":
                    durations_s = [command.duration_s for command in planned]
                    left_s = self._options.horizon_s + _ROUNDING_S
                    rows += rows_within(left_s, goal, names, later, durations_s, limits)
                sent_s, number = self._move(link, rows)
            if self._options.mode == "action":
                self._await_acceptance(link, number)
            wanted.update(zip(self._profile.arm_joints, goal.tolist(), strict=True))
        gripper = self._profile.gripper
        names = tuple(command.names)
        if gripper is not None and gripper.joint in wanted:
            if self._options.gripper == "none":
                names = tuple(name for name in names if name != gripper.joint)
            else:
                finger = measured.get(gripper.joint)
                low, high = sorted((gripper.closed_position, gripper.open_position))
                target = wanted[gripper.joint] = min(max(wanted[gripper.joint], low), high)
                self._fingers.move(link, target, None if finger is None else finger.position)
        return replace(
            command,
            names=names,
            position=np.array([wanted[name] for name in names]),
            duration_s=sent_s,
        )

    def hold(self) -> None:
        """Brake evenly to a standstill and hold; the gripper keeps its grasp.

        The controller gets one point: the posture at which the arm comes to rest with 80 % of its
        acceleration limits. In mode action it is a goal that replaces the running one, which is
        cancelled if the controller rejects it.

        Raises:
            StateError: not open.
            NotReadyError: the position of the arm is unknown. The running goal is cancelled;
                published trajectories are executed to their end.
        """
        link = self._opened()
        with self._lock:
            start = self._watch.moving_from(link, by_reference=not self._fault)
            if start is None:
                self._own_cancel = True
                link.cancel_goals()
                raise NotReadyError(
                    f"{self._options.joint_states} has ceased, so that nobody knows where to "
                    "hold; the controller "
                    "keeps its last point."
                )
            position, duration_s = stop_point(*start, self._limits())
            message = to_message(self._profile.arm_joints, [(position, duration_s)], rest=True)
            self._place = self._target = None
            if self._options.mode != "action":
                link.publish(message)
                return
            self._goal += 1
            self._goal_note = "holding"
            goal = self._goal
            link.send_goal(goal, message)
        if not link.wait_accepted(goal, self._options.goal_timeout_s):
            self._own_cancel = True
            link.cancel_goals()

    def recover(self) -> str:
        """Clear the fault on a person's request: commands are executed again.

        Returns:
            The cleared fault.

        Raises:
            StateError: there is none, or it is not open.
            RefusedError: joint states or controller are missing; names a remedy.
        """
        link = self._opened()
        if not self._fault:
            raise StateError(f"{self._options.controller} has no fault to recover from.")
        try:
            self._watch.check_fresh(link.joints())
            self._watch.check_controller(link)
        except NotReadyError as error:
            raise RefusedError(
                f"The arm cannot be recovered: {error.message}", hint=error.hint, rule="recovery"
            ) from error
        return self._forget_fault()

    def _forget_fault(self) -> str:
        fault, self._fault = self._fault, ""
        self._place = self._target = None
        return fault

    def close(self) -> None:
        """Hold and disconnect; may be called twice and before `open`."""
        link = self._link
        if link is None:
            return
        try:
            if self._target is not None:
                self.hold()
        except (NotReadyError, StateError):
            pass  # the controller holds its last point by itself
        finally:
            self._link = None
            link.close()

    def ended(self, goal: int, end: End, text: str) -> None:
        """Handle the end of a goal; called by the link."""
        with self._lock:
            is_newest = goal == self._goal
            if not is_newest:
                # replaced by a newer one of this driver, which the controller reports as preempted
                return
            own_cancel, self._own_cancel = self._own_cancel, False
            self._end, self._goal_note = end, f"{end.value}: {text}" if text else end.value
            if end in FAULTS and not (end is End.CANCELLED and own_cancel):
                self._fault = worded(end, text)

    def _judge(self, link: ControllerLink) -> None:
        """Check tolerances: only the action reports violations, so in the other modes the
        controller's own error is compared with the options.
        """
        report = link.report()
        if self._options.mode == "action" or report is None or self._fault:
            return
        with self._lock:
            if self._target is None or report.received_s < self._sent_s + _SETTLE_S:
                return  # the report is from before the command
            goal, due_s = self._target
            places = dict(zip(self._profile.arm_joints, goal.tolist(), strict=True))
            self._fault = violation(
                report,
                link.joints(),
                places,
                time.monotonic() - due_s,
                self._options,
                self._profile.kinds,
            )
            is_violated = bool(self._fault)
        if is_violated:
            self.hold()

    def _move(self, link: ControllerLink, rows: list[tuple[F64, float]]) -> tuple[float, int]:
        """Send a target and the later ones, each with its time; return the duration that the limits
        allow for the first, and the number of the goal.
        """
        cubic = self._options.interpolation == "cubic"
        joints = link.joints()
        start = np.array([joints[name].position for name in self._profile.arm_joints])
        goal, asked_s = rows[0]
        duration_s = max(asked_s, shortest_s(start, goal, self._limits(), cubic=cubic))
        rows = [(goal, duration_s), *rows[1:]]
        message = to_message(self._profile.arm_joints, rows, rest=cubic)
        self._sent_s = time.monotonic()
        self._place = goal
        self._target = (rows[-1][0], self._sent_s + sum(row_s for _, row_s in rows))
        self._goal += 1
        if self._options.mode != "action":
            link.publish(message)
        else:
            self._goal_note, self._end = "executing", None
            link.send_goal(self._goal, message)
        return duration_s, self._goal

    def _await_acceptance(self, link: ControllerLink, number: int) -> None:
        """Wait without the lock: `hold` must not wait for it, and the link reports from its own
        thread.
        """
        if link.wait_accepted(number, 2 * self._options.goal_timeout_s):
            return
        with self._lock:
            self._place = self._target = None
            note, end = self._goal_note, self._end
        if end is End.REJECTED:
            raise InvalidInputError(f"{self._options.controller} did not take a goal: {note}.")
        raise NotReadyError(
            f"{self._options.controller} did not answer a goal in "
            f"{self._options.goal_timeout_s:g} s."
        )

    def _limits(self) -> JointLimits:
        assert self._profile.limits is not None  # open() has checked
        return self._profile.limits

    def _opened(self) -> ControllerLink:
        if self._link is None:
            raise StateError("The connection to ros2_control is not open.")
        return self._link
