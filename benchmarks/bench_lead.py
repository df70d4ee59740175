"""Delay of the joint command after a person who leads by the page presses the switch, and after it
is released.

    .venv/bin/python benchmarks/bench_lead.py [--presses 60]

A page without a browser sends samples at 50 Hz to a server whose simulated FR3 is led. The delay is
from the sample that presses the switch to the first joint command that moves, received by a
separate node; the echo is the round trip to control that the page shows. All clocks are this
machine's. The floor is one period of the lead, 20 ms: a sample that arrives in time waits for none
of it.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "plugins" / "rn-view" / "tests"))

from lead_client import LeadPage  # noqa: E402
from page_cell import PageCell, served  # noqa: E402

from roboneuron.ros.environment import prepare_environment  # noqa: E402

PERIOD_MS = 20.0
CONFIG = """
[robot]
name = "fr3"
[control]
controller = "urdf"
[view]
enabled = true
port = 0
[supervisor]
state_directory = "{state}"
"""
PUSH = [0.05, 0.0, 0.0, 0.0, 0.0, 0.0]
_MOVES_RAD = 1e-5


class Commands:
    """Times of commands that move the joints relative to the previous command."""

    def __init__(self) -> None:
        self.moved_s: list[float] = []
        self._last: np.ndarray | None = None

    def take(self, message: object) -> None:
        """Handle a JointTrajectory."""
        position = np.array(message.points[-1].positions)  # type: ignore[attr-defined]
        if self._last is not None and np.abs(position - self._last).max() > _MOVES_RAD:
            self.moved_s.append(time.monotonic())
        self._last = position


def watch(commands: Commands, stack: ExitStack) -> None:
    """Receive joint commands until the stack is closed."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import qos_profile_sensor_data
    from trajectory_msgs.msg import JointTrajectory

    context = rclpy.Context()
    context.init()
    node = rclpy.create_node("onlooker", context=context)
    node.create_subscription(
        JointTrajectory, "/fr3/joint_trajectory", commands.take, qos_profile_sensor_data
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    stack.callback(context.shutdown)
    stack.callback(executor.shutdown)


def page_cell(folder: Path, config: str, stack: ExitStack) -> PageCell:
    """A cell without a camera."""
    return PageCell(folder, config, stack, ("robot", "control"))


def measure(url: str, commands: Commands, presses: int) -> tuple[list[float], list[float]]:
    """Delays from presses to commands, and of echoes [ms]."""
    found: list[float] = []
    with LeadPage(url) as page:
        if refused := page.lead():
            raise SystemExit(refused)
        sign = 1.0
        for _ in range(presses):
            page.push([0.0] * 6, 0.5, held=False)
            pressed_s, sign = time.monotonic(), -sign
            page.push([sign * value for value in PUSH], 0.3)
            after = [at_s for at_s in commands.moved_s if at_s >= pressed_s]
            if after:
                found.append((after[0] - pressed_s) * 1e3)
        echoes = [echo[4] * 1e3 for echo in page.echoes if echo[4] == echo[4]]
        page.ask({"back": 1})
    return sorted(found), sorted(echoes)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presses", type=int, default=60)
    parser.add_argument("--quick", action="store_true", help="only whether it works")
    arguments = parser.parse_args()
    presses = 5 if arguments.quick else arguments.presses
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory) / "cell"
        prepare_environment(Path(directory) / "log")
        text = CONFIG.format(state=folder / "state")
        with served(folder, partial(page_cell, folder, text)) as cell, ExitStack() as stack:
            commands = Commands()
            watch(commands, stack)
            found, echoes = measure(cell.url, commands, presses)
    for name, values in (("press -> joint command", found), ("page -> control -> page", echoes)):
        if not values:
            print(f"missed: no {name}")
            continue
        median, p99 = (
            statistics.median(values),
            values[min(len(values) - 1, len(values) * 99 // 100)],
        )
        print(
            f"{name}: n {len(values)}, median {median:.1f} ms ({median / PERIOD_MS:.2f} periods), "
            f"p99 {p99:.1f} ms ({p99 / PERIOD_MS:.2f} periods), max {values[-1]:.1f} ms"
        )
    return 0 if len(found) == presses else 1


if __name__ == "__main__":
    raise SystemExit(main())
