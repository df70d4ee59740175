"""The driver `ros2-control`: joint commands -> a joint_trajectory_controller, its states and faults -> the robot's."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rn_driver_ros2control.link import ControllerLink, ControllerReport, End, Measured
from rn_driver_ros2control.options import Ros2ControlOptions
from rn_driver_ros2control.trajectory import shortest_s, stop_point, to_message
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    JointCommand,
    JointLimits,
    JointSample,
    MissingDependencyError,
    NotReadyError,
    RobotProfile,
    RobotState,
    StateError,
    Topics,
    UnsafeError,
)

F64 = NDArray[np.float64]
_MOST_CLOCK_ERROR_NS = 500_000_000
"""A stamp farther than this from ROS time here is of another clock; then the time of arrival is used."""
_SAME_OPENING = 0.02
"""Share of the gripper's travel: a smaller change is no new command."""
_LEAST_CLOSE = 0.1
"""A reference farther than this [rad or m] from the measured joint is not where a stop begins."""
_SETTLE_S = 0.05
"""Time from sending until the controller's reports are about what was sent."""
_FAULTS = (End.PATH_TOLERANCE, End.GOAL_TOLERANCE, End.PREEMPTED, End.CANCELLED, End.ABORTED)


class Ros2ControlDriver:
    """Follows the protocol `RobotDriver`; every method may be called from any thread.

    The controller keeps the arm: it interpolates, holds its last point when commands cease or this process dies, and
    checks its own tolerances. What it reports as a fault is kept here until the robot is stopped and started again.
    """

    def __init__(self, config: Ros2ControlOptions | None, profile: RobotProfile, topics: Topics) -> None:
        """Remember what to drive."""
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
        self._target: tuple[F64, float] | None = None
        self._sent_s = 0.0
        self._opening: float | None = None
        self._stamp_ns = 0

    def open(self) -> None:
        """Find the controller, its states and the gripper; nothing moves.

        Raises:
            ConfigurationError: the controller moves other joints, the profile is no arm, or another node publishes the
                robot's own `joint_states`.
            NotReadyError: controller, joint states or gripper are not there, or the controller is not active.
            MissingDependencyError: control_msgs is not installed.
            StateError: it is open already.
        """
        if self._link is not None:
            raise StateError("The connection to ros2_control is open already.")
        if self._profile.limits is None or not self._profile.arm_joints:
            raise ConfigurationError(f"The robot {self._profile.name!r} has no arm; ros2-control moves arms.")
        link = self._connect()
        try:
            link.open(self)
            self._link = link
            self._await_states(link)
            self._check_topics()
        except BaseException:
            self._link = None
            link.close()
            raise
        self._fault, self._goal_note, self._target, self._opening = "", "none", None, None

    def _connect(self) -> ControllerLink:
        """The link to use; tests have others."""
        try:
            from rn_driver_ros2control.ros_link import RosLink  # heavy
        except ModuleNotFoundError as error:
            if error.name is None or not error.name.startswith("control_msgs"):
                raise
            raise MissingDependencyError(
                "The ROS 2 types of ros2_control are not installed (package control_msgs).",
                hint="pip install ./plugins/rn-interfaces-control (in RoboNeuron's source folder) compiles them.",
            ) from error
        return RosLink(self._options, self._profile.arm_joints)

    def _await_states(self, link: ControllerLink) -> None:
        deadline_s = time.monotonic() + self._options.connect_timeout_s
        while True:
            missing = [name for name in self._profile.arm_joints if name not in link.joints()]
            report = link.report()
            if not missing and (report is not None or not self._options.watch_controller):
                break
            if time.monotonic() > deadline_s:
                if missing:
                    raise NotReadyError(f"{self._options.joint_states} does not tell {', '.join(missing)}.")
                raise NotReadyError(self._inactive())
            time.sleep(0.02)
        if report is not None and set(report.joints) != set(self._profile.arm_joints):
            raise ConfigurationError(
                f"{self._options.controller} moves {', '.join(report.joints)}, the profile {self._profile.name!r} has "
                f"{', '.join(self._profile.arm_joints)}; choose another controller or robot."
            )

    def _check_topics(self) -> None:
        """Two publishers of one robot's joint states: this driver would read what its own module repeats."""
        if self._topics.publisher_types("joint_states"):
            raise ConfigurationError(
                "Another node already publishes `joint_states` in the robot's namespace.",
                hint="Set [robot] namespace to one that ros2_control does not use; the driver reads absolute names.",
            )

    def read(self) -> RobotState:
        """Return the newest measured state.

        `detail` holds "controller" (active, inactive, absent, not watched), "mode", "goal" (how the newest ended),
        "fault" (empty without), "following_error" (greatest, rad or m), "speed_scaling" and "gripper".

        Raises:
            StateError: not open.
            NotReadyError: the joint states have ceased.
            UnsafeError: a measured value is not finite.
        """
        link = self._opened()
        measured = link.joints()
        self._judge(link)
        names = self._profile.arm_joints
        self._check_fresh(measured)
        gripper = self._profile.gripper
        if gripper is not None and gripper.joint in measured:
            names = (*names, gripper.joint)
        chosen = [measured[name] for name in names]
        position = np.array([joint.position for joint in chosen])
        velocities = [joint.velocity for joint in chosen]
        velocity = None if None in velocities else np.array(velocities, dtype=np.float64)
        if not np.isfinite(position).all() or (velocity is not None and not np.isfinite(velocity).all()):
            raise UnsafeError(f"{self._options.joint_states} tells a value that is not finite.")
        opening = None
        if gripper is not None and gripper.joint in measured:
            opening = gripper.to_opening(measured[gripper.joint].position)
        joints = JointSample(names=names, position=position, velocity=velocity, stamp_ns=self._stamp(chosen))
        return RobotState(joints=joints, gripper_open=opening, detail=self._detail(link))

    def send(self, command: JointCommand) -> JointCommand:
        """Move towards `command`; it replaces the one before. Arm joints that it lacks stay where they were sent.

        Returns:
            What was sent: positions within the limits, the duration that they allow, and no gripper joint when the
            options drive none.

        Raises:
            InvalidInputError: unknown joints, unequal lengths, no duration, a value that is not finite, or a goal that
                the controller rejects; nothing moves.
            NotReadyError: states have ceased, or the controller is absent, inactive or does not answer.
            UnsafeError: a fault stands; see `recover`.
            StateError: not open.
        """
        link = self._opened()
        wanted = self._checked(command)
        if self._fault and self._options.resume_after_fault:
            self.recover()
        measured = link.joints()
        self._judge(link)
        if self._fault:
            raise UnsafeError(
                f"{self._options.controller}: {self._fault}. Commands are refused until a person has looked.",
                hint="Stop and start the robot when the cause is gone.",
            )
        self._check_fresh(measured)
        self._check_controller(link)
        arm = [name for name in command.names if name in self._profile.arm_joints]
        sent_s = command.duration_s
        if arm:
            with self._lock:
                goal = self._full_target(wanted, measured)
                sent_s, number = self._move(link, goal, command.duration_s)
            if self._options.mode == "action":
                self._await_acceptance(link, number)
            wanted.update(zip(self._profile.arm_joints, goal.tolist(), strict=True))
        gripper = self._profile.gripper
        names = tuple(command.names)
        if gripper is not None and gripper.joint in wanted:
            if self._options.gripper == "none":
                names = tuple(name for name in names if name != gripper.joint)
            else:
                self._move_gripper(link, wanted[gripper.joint])
        return replace(command, names=names, position=np.array([wanted[name] for name in names]), duration_s=sent_s)

    def hold(self) -> None:
        """Brake evenly to a standstill and stay there; the gripper keeps its grasp.

        The controller is sent one point: where the arm comes to rest with 80 % of its acceleration limits. In mode
        action it is a goal that replaces the running one, which is cancelled when the controller rejects it.

        Raises:
            StateError: not open.
            NotReadyError: nobody tells where the arm is. The running goal is cancelled; what was published before is
                executed to its end.
        """
        link = self._opened()
        with self._lock:
            start = self._moving_from(link)
            if start is None:
                self._cancel(link)
                raise NotReadyError(
                    f"{self._options.joint_states} has ceased, so that nobody knows where to hold; the controller "
                    "keeps its last point."
                )
            position, duration_s = stop_point(*start, self._limits())
            message = to_message(self._profile.arm_joints, position, duration_s, rest=True)
            self._target = None
            if self._options.mode == "topic":
                link.publish(message)
                return
            self._goal += 1
            self._goal_note = "holding"
            goal = self._goal
            link.send_goal(goal, message)
        if not link.wait_accepted(goal, self._options.goal_timeout_s):
            self._cancel(link)

    def recover(self) -> None:
        """Forget the fault: commands are followed again. Raises StateError unless open."""
        self._opened()
        self._fault = ""
        self._target = None

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
        """A goal is over; called by the link."""
        with self._lock:
            is_newest = goal == self._goal
            if not is_newest:
                return  # replaced by a newer one of this driver, which the controller reports as preempted
            own_cancel, self._own_cancel = self._own_cancel, False
            self._end, self._goal_note = end, f"{end.value}: {text}" if text else end.value
            if end in _FAULTS and not (end is End.CANCELLED and own_cancel):
                self._fault = self._worded(end, text)

    def _worded(self, end: End, text: str) -> str:
        said = f" ({text})" if text else ""
        if end is End.CANCELLED:
            return f"another client has cancelled the goal{said}"
        if end is End.ABORTED:
            return f"the goal was aborted{said}: another client sends goals, or the controller was deactivated"
        return f"{end.value}{said}"

    def _judge(self, link: ControllerLink) -> None:
        """In mode topic nobody reports violated tolerances: compare the controller's own error with the options."""
        report, options = link.report(), self._options
        if options.mode != "topic" or report is None or self._fault:
            return
        with self._lock:
            if self._target is None or report.received_s < self._sent_s + _SETTLE_S:
                return  # the report is about what was before the command
            if options.path_tolerance:
                self._judge_error(report, options.path_tolerance, End.PATH_TOLERANCE)
            goal, due_s = self._target
            is_due = time.monotonic() > due_s + options.goal_time_tolerance_s
            if is_due and options.goal_tolerance and options.goal_time_tolerance_s and not self._fault:
                self._judge_goal(link, goal)
            is_violated = bool(self._fault)
        if is_violated:
            self.hold()

    def _judge_error(self, report: ControllerReport, bound: float, end: End) -> None:
        worst = max(report.error, key=lambda name: abs(report.error[name]), default="")
        if worst and abs(report.error[worst]) > bound:
            self._fault = f"{end.value}: {worst} is {abs(report.error[worst]):.3g} off, allowed are {bound:g}"

    def _judge_goal(self, link: ControllerLink, goal: F64) -> None:
        measured, bound = link.joints(), self._options.goal_tolerance
        off = {n: abs(measured[n].position - g) for n, g in zip(self._profile.arm_joints, goal.tolist(), strict=True)}
        worst = max(off, key=lambda name: off[name])
        if off[worst] > bound:
            self._fault = f"{End.GOAL_TOLERANCE.value}: {worst} is {off[worst]:.3g} off, allowed are {bound:g}"

    def _checked(self, command: JointCommand) -> dict[str, float]:
        gripper = self._profile.gripper
        known = {*self._profile.arm_joints, *(() if gripper is None else (gripper.joint,))}
        unknown = [name for name in command.names if name not in known]
        if unknown or len(set(command.names)) != len(command.names) or not command.names:
            asked = ", ".join(command.names) or "no joint"
            raise InvalidInputError(f"A command is for {asked}; known are {', '.join(sorted(known))}, once each.")
        if command.position.shape != (len(command.names),) or not np.isfinite(command.position).all():
            raise InvalidInputError(f"A command for {len(command.names)} joints holds {command.position.tolist()}.")
        if not np.isfinite(command.duration_s) or command.duration_s <= 0.0:
            raise InvalidInputError(f"A command lasts {command.duration_s} s, expected more than 0.")
        return dict(zip(command.names, command.position.tolist(), strict=True))

    def _check_fresh(self, joints: Mapping[str, Measured]) -> None:
        oldest_s = min((joints[n].received_s for n in self._profile.arm_joints if n in joints), default=0.0)
        age_s = time.monotonic() - oldest_s
        if age_s > self._options.state_timeout_s:
            raise NotReadyError(
                f"{self._options.joint_states} has been silent for {age_s:.1f} s.",
                hint="Look whether ros2_control and its joint_state_broadcaster run.",
            )

    def _check_controller(self, link: ControllerLink) -> None:
        state = self._controller_state(link)
        if state == "absent":
            raise NotReadyError(
                f"The controller {self._options.controller} has gone.", hint="Load and activate it: `ros2 control`."
            )
        if state == "inactive":
            raise NotReadyError(self._inactive())

    def _inactive(self) -> str:
        return (
            f"{self._options.controller} is there but not active: {self._options.controller}/controller_state is "
            "silent. Activate it: `ros2 control switch_controllers --activate "
            f"{self._options.controller.rpartition('/')[2]}`."
        )

    def _controller_state(self, link: ControllerLink) -> str:
        if not link.is_present():
            return "absent"
        if not self._options.watch_controller:
            return "not watched"
        report = link.report()
        is_fresh = report is not None and time.monotonic() - report.received_s <= self._options.state_timeout_s
        return "active" if is_fresh else "inactive"

    def _full_target(self, wanted: dict[str, float], joints: Mapping[str, Measured]) -> F64:
        """Positions of all arm joints, within the limits."""
        names, limits = self._profile.arm_joints, self._limits()
        rest = [joints[name].position for name in names] if self._target is None else self._target[0].tolist()
        goal = [wanted.get(name, rest[index]) for index, name in enumerate(names)]
        clipped: F64 = np.clip(np.array(goal), limits.lower, limits.upper)
        return clipped

    def _move(self, link: ControllerLink, goal: F64, duration_s: float) -> tuple[float, int]:
        """Send `goal`; returns the duration that the limits allow, and the number of the goal."""
        cubic = self._options.interpolation == "cubic"
        joints = link.joints()
        start = np.array([joints[name].position for name in self._profile.arm_joints])
        duration_s = max(duration_s, shortest_s(start, goal, self._limits(), cubic=cubic))
        message = to_message(self._profile.arm_joints, goal, duration_s, rest=cubic)
        self._sent_s = time.monotonic()
        self._target = (goal, self._sent_s + duration_s)
        self._goal += 1
        if self._options.mode == "topic":
            link.publish(message)
        else:
            self._goal_note, self._end = "executing", None
            link.send_goal(self._goal, message)
        return duration_s, self._goal

    def _await_acceptance(self, link: ControllerLink, number: int) -> None:
        """Without the lock: `hold` must not wait for it, and the link reports from its own thread."""
        if link.wait_accepted(number, 2 * self._options.goal_timeout_s):
            return
        with self._lock:
            self._target = None
            note, end = self._goal_note, self._end
        if end is End.REJECTED:
            raise InvalidInputError(f"{self._options.controller} did not take a goal: {note}.")
        raise NotReadyError(f"{self._options.controller} did not answer a goal in {self._options.goal_timeout_s:g} s.")

    def _move_gripper(self, link: ControllerLink, position: float) -> None:
        gripper = self._profile.gripper
        if gripper is None:
            return
        opening = gripper.to_opening(position)
        if self._opening is not None:
            is_small = abs(opening - self._opening) <= _SAME_OPENING
            if opening == self._opening or (is_small and opening not in (0.0, 1.0)):
                return  # a policy repeats its gripper value with every action; a goal each time would never end
        self._opening = opening
        link.move_gripper(gripper.to_position(opening))

    def _moving_from(self, link: ControllerLink) -> tuple[F64, F64] | None:
        """Where a stop begins: the controller's reference where it is near the arm, otherwise the measured joints.

        After a fault it is always these: an arm that was blocked must not go on pressing.
        """
        joints, report, names = link.joints(), link.report(), self._profile.arm_joints
        try:
            self._check_fresh(joints)
        except NotReadyError:
            return None
        position = np.array([joints[name].position for name in names])
        velocity = np.array([joints[name].velocity or 0.0 for name in names])
        if report is not None and not self._fault and self._controller_state(link) == "active":
            wanted = np.array([report.reference.get(name, (np.nan, 0.0)) for name in names])
            if np.isfinite(wanted).all() and np.abs(wanted[:, 0] - position).max() < _LEAST_CLOSE:
                return wanted[:, 0], wanted[:, 1]
        return position, np.where(np.isfinite(velocity), velocity, 0.0)

    def _cancel(self, link: ControllerLink) -> None:
        self._own_cancel = True
        link.cancel_goals()

    def _stamp(self, joints: list[Measured]) -> int:
        """When the oldest of `joints` was measured, in ROS time here; never before what was told earlier."""
        now_ns, oldest = self._topics.now_ns(), min(joints, key=lambda joint: joint.received_s)
        stamp_ns = oldest.stamp_ns
        if abs(now_ns - stamp_ns) > _MOST_CLOCK_ERROR_NS:
            stamp_ns = now_ns - int((time.monotonic() - oldest.received_s) * 1e9)
        self._stamp_ns = max(self._stamp_ns, stamp_ns)
        return self._stamp_ns

    def _detail(self, link: ControllerLink) -> dict[str, str]:
        report = link.report()
        error = max((abs(value) for value in report.error.values()), default=0.0) if report is not None else 0.0
        return {
            "controller": self._controller_state(link),
            "mode": self._options.mode,
            "goal": self._goal_note,
            "fault": self._fault,
            "following_error": f"{error:.5f}",
            "speed_scaling": "" if report is None else f"{report.speed_scaling:g}",
            "gripper": "not driven: option gripper is none" if self._options.gripper == "none" else link.gripper_note(),
        }

    def _limits(self) -> JointLimits:
        assert self._profile.limits is not None  # open() has checked
        return self._profile.limits

    def _opened(self) -> ControllerLink:
        if self._link is None:
            raise StateError("The connection to ros2_control is not open.")
        return self._link
