"""The robot module on a test clock, for tests of which command reaches the driver, for how long,
and when the driver holds.

Its threads are not started: the test calls their steps.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboneuron.contract import JointCommand
from roboneuron.modules.robot import RobotModule
from roboneuron.modules.worker import LIMIT_S

ARM = ("a", "b")
MakeHost = Callable[..., Any]
TIMEOUT_S, SERVER_TIMEOUT_S = 0.3, 2.0
LOOSE = 'name = "loose"\nnamespace = "pair"'
"""The robot "pair" with limits that no test of timing reaches, as `name` of [robot]."""
SOON_S = 15.0
"""Milliseconds on an idle machine."""


class Steps:
    """Replaces a worker thread: stores the step, and runs it on request."""

    def __init__(
        self,
        name: str,
        step: Callable[[threading.Event], None],
        status: object,
        *,
        limit_s: float = LIMIT_S,
    ) -> None:
        self.name, self.step, self.status, self.limit_s = name, step, status, limit_s
        self.calls: list[str] = []
        self.ends = True
        self.end = threading.Event()

    def start(self) -> None:
        self.calls.append("start")

    def stop(self) -> bool:
        self.calls.append("stop")
        return self.ends

    def progress(self) -> None:
        self.calls.append(f"progress {self.limit_s:g}")

    def run(self) -> None:
        self.step(self.end)


class Cell:
    """A robot module whose driver records its calls, in order; by default with limits that change
    no command.
    """

    def __init__(
        self,
        make_host: MakeHost,
        *,
        activate: bool = True,
        robot: str = LOOSE,
        replace: dict[str, str] | None = None,
        **options: Any,
    ) -> None:
        replace = {'name = "pair"': robot, **(replace or {})}
        self.host = make_host("robot", replace=replace, **options)
        self.host.create_publisher = None
        self.clock = self.host.clock
        self.robot = RobotModule(self.host)
        self.told: list[Any] = []
        self.driver: Any = self.robot.driver
        self.driver.send = self.send
        self.driver.hold = lambda: self.told.append("hold")
        self.while_sending: Callable[[], object] = lambda: None
        self.reader: Any = self.robot._reader
        self.player: Any = self.robot._player
        self.checker: Any = self.robot._checker
        if activate:
            self.robot.activate()
            self.checker.run()  # loads

    def send(self, command: JointCommand) -> JointCommand:
        self.told.append(command)
        self.while_sending()
        return command

    def command(self, *firsts: float, step_s: float = 0.1, age_s: float = 0.0) -> None:
        """Deliver a trajectory with these positions of the first joint, each within `step_s`."""
        message = JointTrajectory(joint_names=list(ARM))
        for index, first in enumerate(firsts):
            point = JointTrajectoryPoint(positions=[first, 0.0])
            at_ns = round((index + 1) * step_s * 1e9)
            point.time_from_start.sec, point.time_from_start.nanosec = divmod(at_ns, 10**9)
            message.points.append(point)
        self.receive(message, age_s)

    def receive(self, message: JointTrajectory | JointState, age_s: float = 0.0) -> None:
        topic = "joint_trajectory" if isinstance(message, JointTrajectory) else "joint_command"
        self.host.subscribed[type(message), topic](
            message, {"source_timestamp": self.clock.wall_ns - round(age_s * 1e9)}
        )

    def play(self) -> None:
        self.player.run()

    @property
    def sent(self) -> list[tuple[float, float]]:
        """Position of the first joint, and duration, of each command to the driver."""
        return [
            (float(one.position[0]), round(one.duration_s, 6))
            for one in self.told
            if isinstance(one, JointCommand)
        ]

    @property
    def holds(self) -> int:
        return self.told.count("hold")
