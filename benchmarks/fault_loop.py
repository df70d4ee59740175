"""A closed loop with `fault_plugin`, files that make its parts fail, and an observer of the
gantry's true joints.
"""

from __future__ import annotations

import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from plugin_site import installed
from shared_memory import repaired

from roboneuron.config import parse_config
from roboneuron.modules.execution.plugin import FEATURE as EXECUTION
from roboneuron.plugins.discovery import discover
from roboneuron.selection.feature import chosen_forms
from roboneuron.selection.requests import StartChosenInference
from roboneuron.server.loop import ClosedLoop
from roboneuron.supervisor.supervisor import Supervisor
from roboneuron.switching.plugin import FEATURE as SWITCHING

HERE = Path(__file__).parent
PARTS = ("backend", "camera", "gantry", "memory", "camera_clock")
"""Parts that can be made to fail; a file of that name gives the mode."""
CONFIG = """
[robot]
name = "gantry"
{robot}
[perception]
source = "numbering"
cameras = ["front"]
{perception}
[inference]
backend = "{backend}"
{inference}
[control]
controller = "gantry"
{control}
[supervisor]
start_timeout_s = 40.0
stop_timeout_s = 3.0
state_directory = "{folder}/state"
{supervisor}
[plugins.numbering]
rate_hz = {rate_hz}
mode_file = "{folder}/camera"
clock_file = "{folder}/camera_clock"
{camera}
[plugins.gantry]
mode_file = "{folder}/gantry"
[plugins.first]
mode_file = "{folder}/backend"
memory_file = "{folder}/memory"
{policy}
[plugins.second]
tag = 2
mode_file = "{folder}/backend"
memory_file = "{folder}/memory"
{policy}
[plugins.steady]
mode_file = "{folder}/backend"
memory_file = "{folder}/memory"
{policy}
[plugins.steadier]
tag = 2
mode_file = "{folder}/backend"
memory_file = "{folder}/memory"
{policy}
"""
STILL_M = 1e-7


def config_text(folder: Path, rate_hz: float, *, backend: str = "first", **more: str) -> str:
    """The configuration as TOML.

    Args:
        folder: folder of the state and of the files that make parts fail.
        rate_hz: images per second.
        backend: "first" and "second" move without feedback, "steady" and "steadier" swing about a
            position with feedback.
        more: further keys of `robot`, `perception`, `inference`, `control`, `supervisor`, `camera`,
            and of each backend: `policy`.
    """
    tables = ("robot", "perception", "inference", "control", "supervisor", "camera", "policy")
    keys = dict.fromkeys(tables, "") | more
    return CONFIG.format(folder=folder, rate_hz=rate_hz, backend=backend, **keys)


def fail(folder: Path, part: str, mode: str) -> None:
    """Make one of PARTS misbehave; an empty mode ends that."""
    path = folder / part
    temporary = path.with_suffix(".part")
    temporary.write_text(mode)
    temporary.replace(path)


class JointWitness:
    """Records the true position of the gantry's first joint, and counts actions. Times are
    monotonic.

    Args:
        node: node of the observed graph; its executor must spin.
        add: runs a function on a thread that may create subscriptions.
    """

    def __init__(
        self, node: Any, add: Callable[[Callable[[], Any]], Any], namespace: str = "gantry"
    ) -> None:
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray

        self._lock = threading.Lock()
        self._joints: deque[tuple[float, float]] = deque(maxlen=4000)
        self._actions: deque[float] = deque(maxlen=4000)
        self._count = 0
        self.newest_image = -1
        """Number of the image of the newest action."""
        qos = QoSProfile(depth=200)
        true, action = f"/{namespace}/true_joint_states", f"/{namespace}/action"
        add(lambda: node.create_subscription(JointState, true, self._on_joints, qos))
        add(lambda: node.create_subscription(Float64MultiArray, action, self._on_action, qos))

    def _on_joints(self, message: Any) -> None:
        with self._lock:
            self._joints.append((time.monotonic(), float(message.position[0])))

    def _on_action(self, message: Any) -> None:
        with self._lock:
            self._actions.append(time.monotonic())
            self._count += 1
            self.newest_image = round(message.data[4] * 1e9)

    def actions(self) -> int:
        """Number of actions so far."""
        return self._count

    def joints(self) -> list[tuple[float, float]]:
        """Time and position [m] of the first joint, newest last."""
        with self._lock:
            return list(self._joints)

    def changes(self, since_s: float) -> list[tuple[float, float]]:
        """Time and position [m] of each measurement since then that differs from the one before."""
        pairs = itertools.pairwise(self.joints())
        return [
            after
            for before, after in pairs
            if after[0] >= since_s and abs(after[1] - before[1]) > STILL_M
        ]

    def moved_s(self) -> float | None:
        """Time of the joint's last measured motion; None without measurements for 0.5 s."""
        joints = self.joints()
        if not joints or time.monotonic() - joints[-1][0] > 0.5:
            return None
        for (_, before), (at_s, after) in itertools.pairwise(reversed(joints)):
            if abs(after - before) > STILL_M:
                return at_s
        return joints[0][0]

    def stood_s(self) -> float:
        """Time for which the joint has been at rest; 0 without measurements."""
        moved_s = self.moved_s()
        return 0.0 if moved_s is None else time.monotonic() - moved_s

    def moves(self) -> bool:
        """True if it moved within the last 0.3 s."""
        return 0.0 < self.stood_s() < 0.3

    def stands(self) -> bool:
        """True if it has been at rest for 0.4 s."""
        return self.stood_s() > 0.4

    def largest_step_m(self, since_s: float) -> float:
        """Largest distance between two consecutive measurements since then."""
        places = [position for at_s, position in self.joints() if at_s >= since_s]
        return max((abs(b - a) for a, b in itertools.pairwise(places)), default=0.0)


def environment(folder: Path) -> AbstractContextManager[None]:
    """Make the plugin available to this process and its children, on their own ROS domain."""
    return installed(folder, "rn-fault", ("fault_plugin", "fault_parts", "switch_plugin"))


def quiet(_: str) -> None:
    """Ignore the progress of a call."""


@contextmanager
def standing_loop(
    folder: Path, rate_hz: float, **more: str
) -> Iterator[tuple[ClosedLoop, JointWitness]]:
    """The control plane of a cell without running modules; everything is stopped at the end."""
    with environment(folder):
        config = parse_config(config_text(folder, rate_hz, **more))
        supervisor = Supervisor(folder / "state")
        supervisor.on_join = (SWITCHING.on_join or "", EXECUTION.on_join or "")
        try:
            link = supervisor.link
            witness = JointWitness(link.node, link.on_executor, config.namespace)
            with repaired(supervisor):
                loop = ClosedLoop(config, discover, supervisor)
                loop.accept(chosen_forms(lambda: loop.registry))
                yield loop, witness
        finally:
            supervisor.close()


@contextmanager
def moving_cell(
    folder: Path, rate_hz: float, **more: str
) -> Iterator[tuple[ClosedLoop, JointWitness]]:
    """A gantry that follows backend "first" at `rate_hz`."""
    with standing_loop(folder, rate_hz, **more) as (loop, witness):
        loop.start("robot")
        loop.start("perception")
        loop.start("control")
        loop.start("inference", StartChosenInference(instruction="move on", options={}))
        yield loop, witness
