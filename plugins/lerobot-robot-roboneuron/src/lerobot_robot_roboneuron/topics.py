"""The robot's topics in lerobot's process: newest state and images in, actions out.

Actions take the same path as a policy's: to control, labelled with a space that control executes,
so that its limits, watchdogs and stops apply. This process cannot send joint commands.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Bool, Float64MultiArray, MultiArrayDimension
from trajectory_msgs.msg import JointTrajectory

from roboneuron import (
    ConfigurationError,
    ControlSpace,
    InvalidInputError,
    JointSample,
    NotReadyError,
    RefusedError,
    StateError,
    UnsafeError,
    image_from_message,
    joints_from_message,
)
from roboneuron.command import RosLink
from roboneuron.feature import Report, settings, topics

F64 = NDArray[np.float64]

_COMMANDS = ("joint_trajectory", "joint_command")
_REPORT_TIMEOUT_S = 2.0
"""Control reports five times a second."""
_UNNAMED = "_NODE_NAME_UNKNOWN_"
"""Name that rmw_dds_common gives to a node that is not discovered yet."""
_NAMED_S = 2.0


@dataclass(frozen=True, slots=True)
class _Arrived:
    """A message and its arrival time [monotonic s]."""

    message: object
    at_s: float


class RobotTopics:
    """All communication with one robot; for use from one thread besides the link's own."""

    def __init__(self, namespace: str, space: ControlSpace, cameras: Mapping[str, str]) -> None:
        """Args:
        namespace: namespace of the robot's topics. space: control space of the actions. cameras:
        camera of the robot by name in the data set.
        """
        self._prefix = f"/{namespace.strip('/')}"
        self._namespace = namespace.strip("/")
        self._space = space
        self._cameras = dict(cameras)
        self._link = RosLink("lerobot_robot")
        self._changed = threading.Condition()
        self._joints: JointSample | None = None
        self._joints_s = 0.0
        self._images: dict[str, _Arrived] = {}
        self._commands = 0
        self._command: dict[str, float] = {}
        self._reports: dict[str, Report] = {}
        self._stopped = False
        self._stops: int | None = None
        self._malformed = 0
        self._publish: Callable[[Float64MultiArray], None] | None = None

    def open(self, timeout_s: float) -> None:
        """Join the graph and return once states, images and control's reports have arrived.

        Raises:
            NotReadyError: something did not arrive; the message names it and the existing cameras.
            StateError: another node sends actions.
            RefusedError: the emergency stop is latched, or motion needs a new start.
        """
        self._link.open()
        try:
            self._subscribe()
            deadline_s = time.monotonic() + timeout_s
            with self._changed:
                self._changed.wait_for(lambda: not self._missing(), timeout_s)
                missing = self._missing()
            if missing:
                raise NotReadyError(
                    f"{missing} did not come within {timeout_s:g} s.", hint=self._what_there_is()
                )
            self._await_motion_allowed(deadline_s)
            self._check_alone()
            self._publish = self._link.advertise(Float64MultiArray, self._topic(topics.ACTION))
        except BaseException:
            self._link.close()
            raise

    def close(self) -> None:
        """Leave the graph; control holds the arm within its timeout. May be called twice."""
        self._link.close()

    def joints(self, max_age_s: float) -> dict[str, float]:
        """Newest positions by joint [rad or m].

        Raises:
            NotReadyError: none is newer than `max_age_s`.
        """
        with self._changed:
            joints, age_s = self._joints, time.monotonic() - self._joints_s
        if joints is None or age_s > max_age_s:
            raise NotReadyError(
                f"No joint state came on {self._topic(topics.JOINT_STATES)} for {age_s:.2g} s.",
                hint="Has the robot module ended? See `roboneuron status`.",
            )
        return dict(zip(joints.names, joints.position.tolist(), strict=True))

    def image(self, name: str, max_age_s: float) -> NDArray[np.uint8]:
        """Newest image of a camera by its name in the data set: uint8 (H, W, 3) RGB, a copy.

        Raises:
            NotReadyError: none is newer than `max_age_s`.
            InvalidInputError: it is damaged.
        """
        with self._changed:
            arrived = self._images.get(name)
        age_s = time.monotonic() - arrived.at_s if arrived is not None else float("inf")
        if arrived is None or age_s > max_age_s:
            raise NotReadyError(
                f"Camera {self._cameras[name]!r} has sent no image for {age_s:.2g} s.",
                hint="Has perception ended? See `roboneuron status`.",
            )
        message = arrived.message
        assert isinstance(message, Image)
        return np.array(image_from_message(message))

    def send(self, row: F64, answer_timeout_s: float) -> dict[str, float] | None:
        """Send one action; returns the positions by joint that control commanded for it.

        Returns:
            The command [rad or m]; None if control held or refused the action, see `why_held`.

        Raises:
            UnsafeError: the emergency stop is latched.
            RefusedError: motion needs a new start.
            NotReadyError: control no longer reports.
            ConfigurationError: control does not execute this space.
        """
        if self._publish is None:
            raise StateError("The robot's topics are not open.")
        self._check_obeyed()
        message = Float64MultiArray()
        size = self._space.size
        message.layout.dim = [MultiArrayDimension(label=self._space.label, size=size, stride=size)]
        message.data = [float(value) for value in self._space.check(row)]
        with self._changed:
            before = self._commands
        self._publish(message)
        with self._changed:
            self._changed.wait_for(
                lambda: self._commands > before or self._stopped, answer_timeout_s
            )
            answered, command = self._commands > before, dict(self._command)
        self._check_obeyed()
        return command if answered else None

    def why_held(self) -> str:
        """Control's reason for not following; empty if it follows and was only late."""
        report = self._report("control")
        if report is None or report.is_following:
            return ""
        return report.error or report.note

    def image_size(self, name: str) -> tuple[int, int]:
        """Height and width of the newest image of a camera [px]."""
        with self._changed:
            message = self._images[name].message
        assert isinstance(message, Image)
        return int(message.height), int(message.width)

    def _topic(self, name: str) -> str:
        return f"{self._prefix}/{name}"

    def _subscribe(self) -> None:
        link = self._link
        link.subscribe(JointState, self._topic(topics.JOINT_STATES), self._on_joints)
        for name, camera in self._cameras.items():
            link.subscribe(
                Image,
                self._topic(f"camera/{camera}/image"),
                partial(self._on_image, name),
            )
        trajectory, command = _COMMANDS
        link.subscribe(JointTrajectory, self._topic(trajectory), self._on_trajectory)
        link.subscribe(JointState, self._topic(command), self._on_command)
        link.subscribe(DiagnosticArray, topics.DIAGNOSTICS, self._on_reports)
        link.subscribe(Bool, self._topic(settings.EMERGENCY_STOP_TOPIC), self._on_stop)

    def _on_joints(self, message: JointState) -> None:
        try:
            joints = joints_from_message(message)
        except InvalidInputError:
            return  # control counts it; `joints` reports missing states
        with self._changed:
            self._joints, self._joints_s = joints, time.monotonic()
            self._changed.notify_all()

    def _on_image(self, name: str, message: Image) -> None:
        with self._changed:
            self._images[name] = _Arrived(message, time.monotonic())
            self._changed.notify_all()

    def _on_trajectory(self, message: JointTrajectory) -> None:
        if message.points:
            self._note_command(message.joint_names, message.points[-1].positions)

    def _on_command(self, message: JointState) -> None:
        self._note_command(message.name, message.position)

    def _note_command(self, names: list[str], positions: list[float]) -> None:
        with self._changed:
            self._command |= dict(zip(names, map(float, positions), strict=False))
            self._commands += 1
            self._changed.notify_all()

    def _on_stop(self, message: Bool) -> None:
        if message.data:
            with self._changed:
                self._stopped = True
                self._changed.notify_all()

    def _on_reports(self, array: DiagnosticArray) -> None:
        with self._changed:
            for status in array.status:
                namespace, _, node = status.name.strip("/").rpartition("/")
                values = {pair.key: pair.value for pair in status.values}
                if namespace != self._namespace or "state" not in values:
                    continue
                report = Report.from_values(values, received_s=time.monotonic())
                self._reports[node.partition("_")[0]] = report
            self._changed.notify_all()

    def _report(self, kind: str) -> Report | None:
        with self._changed:
            return self._reports.get(kind)

    def _missing(self) -> str:
        """Inputs that have not arrived yet; the lock must be held."""
        absent = []
        if self._joints is None:
            absent.append(f"Joint states on {self._topic(topics.JOINT_STATES)}")
        absent += [
            f"Images of camera {camera!r}"
            for name, camera in self._cameras.items()
            if name not in self._images
        ]
        report = self._reports.get("control")
        if report is None or not report.ready:
            absent.append("A report that control works")
        return " and ".join(absent)

    def _what_there_is(self) -> str:
        node = self._link.node
        start, end = f"{self._prefix}/camera/", "/image"
        cameras = [
            name.removeprefix(start).removesuffix(end)
            for name, _ in node.get_topic_names_and_types()
            # a topic with only this process's subscription has no camera
            if name.startswith(start) and name.endswith(end) and node.count_publishers(name)
        ]
        return (
            f"Under {self._prefix} there are the cameras {', '.join(cameras) or '(none)'}; start "
            "robot, perception and control first, or name the command of a server in `serve`."
        )

    def _await_motion_allowed(self, deadline_s: float) -> None:
        """Raise RefusedError if a stop forbids motion. Only reports newer than this process's own
        subscription count.
        """
        report = self._report("control")
        if report is None:  # excluded by `_missing`
            raise NotReadyError("Control does not report.")
        if report.emergency_stop:
            raise RefusedError(
                "The emergency stop is latched.", hint="A person releases it: `roboneuron estop`."
            )
        if report.needs_start:
            raise RefusedError(
                f"Motion needs a new start after a stop ({report.needs_start}).",
                hint="Move the arm once with a tool such as move_joints, or start a new server.",
            )
        with self._changed:
            self._stops = report.stops
            self._stopped = False
            self._malformed = report.dropped_by.get("malformed", 0)

    def _check_alone(self) -> None:
        """Raise StateError when a policy or another process sends actions."""
        topic, deadline_s = self._topic(topics.ACTION), time.monotonic() + _NAMED_S
        others = self._link.node.get_publishers_info_by_topic(topic)
        # a publisher is discovered before the name of its node
        while others and others[0].node_name == _UNNAMED and time.monotonic() < deadline_s:
            time.sleep(0.05)
            others = self._link.node.get_publishers_info_by_topic(topic)
        if others:
            named = f"{others[0].node_namespace.rstrip('/')}/{others[0].node_name}"
            who = "Another process" if others[0].node_name == _UNNAMED else named
            raise StateError(
                f"{who} sends actions to this robot.",
                hint="Stop the policy (stop_inference) or the other process first.",
            )

    def _check_obeyed(self) -> None:
        """Raise the errors of `send` if control cannot execute actions."""
        with self._changed:
            stopped, report = self._stopped, self._reports.get("control")
        if stopped or (report is not None and report.emergency_stop):
            raise UnsafeError(
                "The emergency stop was triggered: the arm holds, and nothing more is sent.",
                hint="Release it and start again.",
            )
        age_s = time.monotonic() - report.received_s if report is not None else float("inf")
        if report is None or age_s > _REPORT_TIMEOUT_S:
            raise NotReadyError(
                f"Control has not reported for {age_s:.2g} s: the arm holds.",
                hint="See `roboneuron status`.",
            )
        if report.needs_start or report.stops != self._stops:
            raise RefusedError(
                f"There was a stop ({report.needs_start or 'released since'}): the arm holds, and "
                "nothing more is sent.",
                hint="Start anew.",
            )
        if report.dropped_by.get("malformed", 0) > self._malformed:
            raise ConfigurationError(
                f"Control does not execute the actions of this robot: {report.error}",
                hint="Does control run for the same robot, with a controller such as 'urdf'?",
            )
