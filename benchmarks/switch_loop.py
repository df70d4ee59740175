"""A closed loop in this process's control plane with `switch_plugin`, and a recorder of its
topics.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plugin_site import installed
from shared_memory import repaired
from switch_plugin import named_by

from roboneuron.config import parse_config
from roboneuron.modules.execution.plugin import FEATURE as EXECUTION
from roboneuron.plugins.discovery import discover
from roboneuron.selection.feature import chosen_forms
from roboneuron.selection.requests import StartChosenInference
from roboneuron.server.loop import ClosedLoop
from roboneuron.supervisor.supervisor import Supervisor
from roboneuron.switching.plugin import FEATURE as SWITCHING
from roboneuron.switching.replacing import Switching

HERE = Path(__file__).parent
CONFIG = """
[robot]
name = "gantry"
[perception]
source = "numbering"
cameras = ["front"]
[inference]
backend = "first"
[control]
controller = "gantry"
[supervisor]
start_timeout_s = 40.0
stop_timeout_s = 3.0
[plugins.numbering]
rate_hz = {rate_hz}
{camera_options}
[plugins.other]
rate_hz = {rate_hz}
tag = 7
[plugins.second]
tag = 2
"""


def quiet(_: str) -> None:
    """Ignore progress messages."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Sent:
    """One action: when it was sent (DDS source time [ns]), for which image, by which backend, and
    its motion along x [m].

    `row` is its index in the chunk. Camera and chunk have the same period, so `slot` numbers the
    periods of both.
    """

    at_ns: int
    image: int
    tag: int
    x_m: float
    row: int = 0

    @property
    def slot(self) -> int:
        """The period that the action is for."""
        return self.image + self.row


class Witness:
    """Records every action and joint command of one loop."""

    def __init__(self, supervisor: Supervisor, namespace: str) -> None:
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray
        from trajectory_msgs.msg import JointTrajectory

        self._lock = threading.Lock()
        self._actions: list[Sent] = []
        self._commands: list[tuple[int, float, float]] = []
        self._joints: deque[tuple[float, float]] = deque(maxlen=2000)
        link = supervisor.link

        def on_action(message: Any, info: dict[str, Any]) -> None:
            values = message.data
            named = named_by(values[6])
            image, row, tag = named or (round(values[4] * 1e9), 0, round(values[5] * 1e9))
            at_ns = int(info["source_timestamp"])
            sent = Sent(at_ns=at_ns, image=image, tag=tag, x_m=float(values[0]), row=row)
            with self._lock:
                self._actions.append(sent)

        def on_command(message: Any, info: dict[str, Any]) -> None:
            point = message.points[0]
            duration_s = point.time_from_start.sec + point.time_from_start.nanosec / 1e9
            with self._lock:
                self._commands.append(
                    (int(info["source_timestamp"]), float(point.positions[0]), duration_s)
                )

        def on_joints(message: Any) -> None:
            with self._lock:
                self._joints.append((time.monotonic(), float(message.position[0])))

        qos = QoSProfile(depth=200)
        node = link.node
        link.on_executor(
            lambda: node.create_subscription(
                JointState, f"/{namespace}/joint_states", on_joints, qos
            )
        )
        link.on_executor(
            lambda: node.create_subscription(
                Float64MultiArray, f"/{namespace}/action", on_action, qos
            )
        )
        link.on_executor(
            lambda: node.create_subscription(
                JointTrajectory, f"/{namespace}/joint_trajectory", on_command, qos
            )
        )

    def forget(self) -> None:
        """Discard the actions and commands recorded so far."""
        with self._lock:
            self._actions.clear()
            self._commands.clear()

    def actions(self) -> list[Sent]:
        """All actions so far."""
        with self._lock:
            return list(self._actions)

    def more_actions(self, count: int = 5, timeout_s: float = 5.0) -> list[Sent]:
        """Wait for `count` more actions; returns all. TimeoutError when they do not come."""
        enough, deadline_s = len(self.actions()) + count, time.monotonic() + timeout_s
        while len(actions := self.actions()) < enough:
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"not within {timeout_s:g} s: {count} more actions")
            time.sleep(0.01)
        return actions

    def stood_s(self) -> float:
        """How long the first joint has stood still by its measured states [s]; 0 while none
        arrives.
        """
        with self._lock:
            joints = list(self._joints)
        if not joints or time.monotonic() - joints[-1][0] > 0.5:
            return 0.0
        since_s = joints[-1][0]
        for at_s, position in reversed(joints):
            if abs(position - joints[-1][1]) > 1e-7:
                break
            since_s = at_s
        return joints[-1][0] - since_s

    def commands(self) -> list[tuple[int, float, float]]:
        """All joint commands so far: source time [ns], target of the first joint [m], duration
        [s].
        """
        with self._lock:
            return list(self._commands)


@contextmanager
def moving_loop(
    scratch: Path, rate_hz: float, camera_options: str = "", backend_options: str = ""
) -> Iterator[tuple[Switching, Witness]]:
    """Run a gantry that follows backend "first" at `rate_hz`; everything is stopped at the end.

    `camera_options` is TOML: further keys of the camera, then further sections; `backend_options`
    is TOML: keys of both backends.
    """
    with installed(scratch, "rn-switch", ("switch_plugin",)):
        text = CONFIG.format(rate_hz=rate_hz, camera_options=camera_options)
        config = parse_config(f"{text}{backend_options}[plugins.first]\n{backend_options}")
        supervisor = Supervisor(scratch / "state")
        supervisor.on_join = (EXECUTION.on_join or "", SWITCHING.on_join or "")
        try:
            loop = ClosedLoop(config, discover, supervisor)
            loop.accept(chosen_forms(lambda: loop.registry))
            switching = Switching(loop)
            witness = Witness(supervisor, config.namespace)
            loop.start("robot")
            loop.start("perception")
            loop.start("control")
            loop.start("inference", StartChosenInference(instruction="move on", options={}))
            with repaired(supervisor):
                yield switching, witness
        finally:
            supervisor.close()
