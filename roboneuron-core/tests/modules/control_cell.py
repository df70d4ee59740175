"""The control module on a test clock, for tests of which action moves the arm, for how long, and
when the arm is held.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from roboneuron.contract import (
    Action,
    Hold,
    JointCommand,
    JointSample,
)
from roboneuron.modules.control.module import ControlModule
from roboneuron.ros.messages import to_action_message, to_joint_state
from roboneuron.tools.arm.limit_reports import join

SILENT = "the server gave no sign of life"
ARM = ("a", "b")
START = np.array([0.5, -0.5])
MakeHost = Callable[..., Any]
TIMEOUT_S, STATE_TIMEOUT_S, SERVER_TIMEOUT_S = 0.3, 0.25, 2.0


class Cell:
    """An active control whose arm stands at START, with its inputs and outputs."""

    def __init__(self, make_host: MakeHost, *, activate: bool = True, **options: Any) -> None:
        self.host = make_host("control", **options)
        self.clock = self.host.clock
        self.control = ControlModule(self.host)
        join(self.host)
        for extend in self.host.on_configured:
            extend(self.control)
        self.asked: list[tuple[Action, JointSample, float]] = []
        self.takes_s = 0.0
        self.answer: JointCommand | Hold | None = None
        self._compute = self.control.controller.compute
        self.control.controller.compute = self.compute  # type: ignore[method-assign]
        self.position = START.copy()
        if activate:
            self.control.activate()
            self.measure()

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        self.asked.append((action, joints, step_s))
        self.clock.go(self.takes_s)
        return self.answer or self._compute(action, joints, step_s)

    def measure(self, **changes: Any) -> None:
        """Deliver a joint state."""
        values: dict[str, Any] = {
            "names": ARM,
            "position": self.position.copy(),
            "stamp_ns": self.clock.wall_ns,
        }
        message = to_joint_state(JointSample(**(values | changes)))
        self.host.subscribed[JointState, "joint_states"](message)

    def act(self, metres: float = 0.01, *, age_s: float = 0.0, sent_ns: int | None = None) -> None:
        """Deliver an action."""
        self.receive(to_action_message(np.array([metres, 0, 0, 0, 0, 0, 1.0])), age_s, sent_ns)

    def receive(
        self, message: Float64MultiArray, age_s: float = 0.0, sent_ns: int | None = None
    ) -> None:
        source_ns = self.clock.wall_ns - round(age_s * 1e9) if sent_ns is None else sent_ns
        on_action = self.host.subscribed[Float64MultiArray, "action"]
        on_action(message, {"source_timestamp": source_ns})

    def go(self, seconds: float, *, measured: bool = True) -> None:
        """Advance time; the arm is measured at the end."""
        self.clock.go(seconds)
        if measured:
            self.measure()

    def watch(self) -> None:
        self.host.repeated[0][1]()

    @property
    def commands(self) -> list[list[float]]:
        return [list(one.points[0].positions) for one in self.messages]

    @property
    def messages(self) -> list[Any]:
        return self.host.publishers["joint_trajectory"].messages  # type: ignore[no-any-return]

    @property
    def poses(self) -> list[PoseStamped]:
        return self.host.publishers["ee_pose"].messages  # type: ignore[no-any-return]

    @property
    def code(self) -> str:
        return str(self.host.values().get("hold_code", ""))

    def drops(self) -> dict[str, int]:
        """Number of dropped messages by reason, except holds."""
        return {k: v for k, v in self.host.drops().items() if k != "holds"}


def duration_s(message: JointTrajectory) -> float:
    time_s = message.points[0].time_from_start
    return time_s.sec + time_s.nanosec / 1e9  # type: ignore[no-any-return]


STOPS: dict[str, Callable[[Cell], None]] = {
    "emergency_stop": lambda cell: setattr(cell.host, "stopped", True),
    "server_silent": lambda cell: setattr(cell.host, "silence_s", SERVER_TIMEOUT_S + 1e-6),
    "needs_new_start": lambda cell: setattr(cell.host, "needs_start", "a stop"),
    "stale_joint_state": lambda cell: cell.go(STATE_TIMEOUT_S + 1e-6, measured=False),
}
