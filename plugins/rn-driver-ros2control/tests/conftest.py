"""A link to a stand-in controller in this process: what the driver does, without a ROS graph."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np
import pytest
from trajectory_msgs.msg import JointTrajectory

from rn_testing.fakes import MemoryTopics
from roboneuron import NotReadyError, RobotProfile

# where nothing could be compiled; then the tests are skipped
with contextlib.suppress(ModuleNotFoundError):
    from rn_driver_ros2control.driver import Ros2ControlDriver
    from rn_driver_ros2control.forwarding import PositionForwarder
    from rn_driver_ros2control.link import (
        ControllerReport,
        End,
        GoalObserver,
        ListedController,
        MeasuredJoint,
    )
    from rn_driver_ros2control.options import Ros2ControlOptions
    from rn_driver_ros2control.standin import (
        GOAL_VIOLATED,
        PATH_VIOLATED,
        SUCCESSFUL,
        StandInController,
        Tolerances,
    )

    _ENDS = {
        SUCCESSFUL: End.SUCCEEDED,
        PATH_VIOLATED: End.PATH_TOLERANCE,
        GOAL_VIOLATED: End.GOAL_TOLERANCE,
    }

_CYCLE_S = 0.005
_FINGER_M_S = 0.1


class MemoryLink:
    """Follows `ControllerLink`; a thread lets the stand-in's time run."""

    def __init__(self, options: Ros2ControlOptions, profile: RobotProfile) -> None:
        self.options, self.profile = options, profile
        assert profile.home_rad is not None
        joints, start = profile.arm_joints, profile.home_rad
        self.forwarder: PositionForwarder | None = None
        if options.controller_type == "forward-position":  # in an order of its own
            joints, start = joints[::-1], start[::-1]
            self.forwarder = PositionForwarder(joints)
        self.controller = StandInController(joints, start)
        self.listing: ListedController | None = None
        self.is_there = True
        self.answers = True
        self.tells = True
        self.sent: list[JointTrajectory] = []
        self.gripper_goals: list[float] = []
        self.cancelled = 0
        self._finger = self._finger_goal = 0.04
        self._goal: int | None = None
        self._refused: set[int] = set()
        self._observer: GoalObserver | None = None
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._joints: dict[str, MeasuredJoint] = {}
        self._report: ControllerReport | None = None

    def open(self, observer: GoalObserver) -> None:
        if not self.is_there:
            raise NotReadyError("There is no controller.")
        self._observer = observer
        self._tell(time.time())
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(_CYCLE_S):
            ended: tuple[int, End, str] | None = None
            with self._lock:
                values = None if self.forwarder is None else self.forwarder.due(time.monotonic())
                if values is not None:
                    self.controller.forward(values)
                verdict = self.controller.update(time.time())
                step = _FINGER_M_S * _CYCLE_S
                self._finger += float(np.clip(self._finger_goal - self._finger, -step, step))
                if self.tells:
                    self._tell(time.time())
                if verdict is not None and self._goal is not None:
                    ended, self._goal = (self._goal, _ENDS[verdict.code], verdict.text), None
            if ended is not None and self._observer is not None:
                self._observer.ended(*ended)

    def _tell(self, now_s: float) -> None:
        c, received_s, stamp_ns = self.controller, time.monotonic(), int(now_s * 1e9)
        values = zip(
            (*c.joints, "fr3_finger_joint1"),
            (*c.measured, self._finger),
            (*c.measured_velocity, 0.0),
            strict=True,
        )
        self._joints = {
            n: MeasuredJoint(
                position=float(p), velocity=float(v), stamp_ns=stamp_ns, received_s=received_s
            )
            for n, p, v in values
        }
        if self.forwarder is not None:
            self._report = self.forwarder.report(self._joints, received_s) if c.active else None
        elif c.active:
            self._report = ControllerReport(
                joints=c.joints,
                reference={
                    n: (float(p), float(v))
                    for n, p, v in zip(c.joints, c.reference, c.reference_velocity, strict=True)
                },
                error=dict(zip(c.joints, (c.reference - c.measured).tolist(), strict=True)),
                speed_scaling=1.0,
                received_s=received_s,
            )

    def joints(self) -> Mapping[str, MeasuredJoint]:
        return self._joints

    def report(self) -> ControllerReport | None:
        return self._report

    def listed(self) -> ListedController | None:
        return self.listing

    def is_present(self) -> bool:
        return self.is_there

    def publish(self, trajectory: JointTrajectory) -> None:
        with self._lock:
            self.sent.append(trajectory)
            if self.forwarder is not None:
                self.forwarder.start(trajectory, self._joints, time.monotonic())
            elif self.controller.active and not self.controller.refusal(trajectory, time.time()):
                self.controller.take(trajectory, time.time())

    def send_goal(self, goal: int, trajectory: JointTrajectory) -> None:
        with self._lock:
            self.sent.append(trajectory)
            reason = self.controller.refusal(trajectory, time.time()) or (
                "" if self.controller.active else "not running"
            )
            if reason or not self.answers:
                self._refused.add(goal)
                end = End.REJECTED if reason else End.UNANSWERED
            else:
                replaced, self._goal = self._goal, goal
                bounds = Tolerances(
                    path=dict.fromkeys(self.controller.joints, self.options.path_tolerance),
                    goal=dict.fromkeys(self.controller.joints, self.options.goal_tolerance),
                    goal_time_s=self.options.goal_time_tolerance_s,
                )
                self.controller.take(trajectory, time.time(), bounds)
                goal, end, reason = (
                    replaced or 0,
                    End.ABORTED,
                    "Current goal preempted by new incoming action.",
                )
        if self._observer is not None and goal:
            self._observer.ended(goal, end, reason)

    def end_from_outside(self, end: End, text: str) -> None:
        """Another client, or the controller itself, ends the running goal."""
        with self._lock:
            goal, self._goal = self._goal, None
            self.controller.hold()
        assert goal is not None
        assert self._observer is not None
        self._observer.ended(goal, end, text)

    def wait_accepted(self, goal: int, timeout_s: float) -> bool:
        return goal not in self._refused

    def cancel_goals(self) -> None:
        self.cancelled += 1
        if self._goal is not None:
            self.end_from_outside(End.CANCELLED, "")

    def move_gripper(self, position: float) -> None:
        self.gripper_goals.append(position)
        self._finger_goal = position

    def gripper_note(self) -> str:
        return "reached"

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(2.0)


class Rig:
    """Drivers with memory links, and the links."""

    def __init__(self) -> None:
        self.links: list[MemoryLink] = []
        self.prepare: Callable[[MemoryLink], None] = lambda link: None
        self._drivers: list[Ros2ControlDriver] = []

    @property
    def link(self) -> MemoryLink:
        return self.links[-1]

    def connect(self, driver: Ros2ControlDriver) -> MemoryLink:
        link = MemoryLink(driver._options, driver._profile)
        self.prepare(link)
        self.links.append(link)
        return link

    def driver(self, **options: object) -> Ros2ControlDriver:
        """Open, with these options and the profile of the FR3."""
        from rn_robot_fr3.profile import profile

        driver = Ros2ControlDriver(
            Ros2ControlOptions.model_validate(options), profile(), MemoryTopics()
        )
        driver.open()
        self._drivers.append(driver)
        return driver

    def close(self) -> None:
        for driver in self._drivers:
            driver.close()


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    made = Rig()
    monkeypatch.setattr(Ros2ControlDriver, "_connect", lambda driver: made.connect(driver))
    yield made
    made.close()
