"""Processes and observers of the tests with lerobot's own commands."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from anyio.from_thread import BlockingPortal
from sensor_msgs.msg import JointState

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import DemoAgent
from rn_testing.waiting import wait_until
from roboneuron.command import RosLink
from roboneuron.ros.environment import module_environment

ROOT = Path(__file__).parents[3]
BIN = ROOT / ".venv-lerobot" / "bin"
CONFIG = ROOT / "examples" / "so101.toml"
LEADER = ROOT / "examples" / "scripted_leader.py"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
PATIENT = ("--robot.image_timeout_s=10", "--robot.start_timeout_s=120")
"""Late images on a busy machine are not the subject of these tests."""
AT_REST_RAD = 2e-3
"""Travel of a joint within a tenth of a second that may be noise of the simulation."""


class Watch:
    """All measured joints of the arm, with the time of arrival [monotonic s]."""

    def __init__(self, namespace: str, joints: Sequence[str]) -> None:
        self._joints = joints
        self.seen: list[tuple[float, np.ndarray]] = []
        self._link = RosLink("watch")
        self._link.open()
        self._link.subscribe(JointState, f"/{namespace}/joint_states", self._take)

    def _take(self, message: JointState) -> None:
        by_name = dict(zip(message.name, message.position, strict=True))
        row = np.array([by_name[name] for name in self._joints])
        self.seen.append((time.monotonic(), row))

    def since(self, begun_s: float) -> np.ndarray:
        return np.array([row for at_s, row in self.seen if at_s >= begun_s])

    def is_moving(self) -> bool:
        recent = self.since(time.monotonic() - 0.3)
        return len(recent) > 3 and bool(np.ptp(recent, axis=0).max() > 10 * AT_REST_RAD)

    def rest_after_s(self, fault_s: float) -> float:
        """Time from a fault until the joints rest [s], observed for 1.5 s longer."""
        wait_until(lambda: time.monotonic() > fault_s + 2.5, 10.0)
        rows = [(at_s, row) for at_s, row in self.seen if at_s >= fault_s]
        last = rows[-1][1]
        away = [at_s for at_s, row in rows if np.abs(row - last).max() > AT_REST_RAD]
        return (away[-1] - fault_s) if away else 0.0

    def close(self) -> None:
        self._link.close()


class Served:
    """A server with which a client has started robot, perception and control."""

    def __init__(self, portal: BlockingPortal, config: Path, log: Path) -> None:
        self._portal = portal
        self._context = portal.wrap_async_context_manager(
            spawned_server(["--config", str(config)], log)
        )
        self._agent = DemoAgent(self._context.__enter__())

    def call(self, tool: str, **arguments: object) -> dict[str, Any]:
        return dict(self._portal.call(self._agent.call, tool, arguments))

    def close(self) -> None:
        self._context.__exit__(None, None, None)


class Lerobot:
    """Processes of lerobot's environment and of the leader; all end with the test."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: list[subprocess.Popen[str]] = []
        self._logs: dict[int, Path] = {}
        # as in a shell: the test's own process uses the ROS packages of another environment
        self.environment = {
            **module_environment(str(BIN / "python"), 0),
            "HF_HUB_OFFLINE": "1",
            "HF_HOME": str(folder / "hf"),
            "PYTHONWARNINGS": "ignore",
        }

    def start(self, command: str, *options: str) -> subprocess.Popen[str]:
        return self._spawn([str(BIN / command), *options], self.environment)

    def teleoperate(self, *options: str) -> subprocess.Popen[str]:
        return self.start(
            "lerobot-teleoperate",
            "--robot.type=roboneuron",
            "--robot.robot=so101",
            *PATIENT,
            "--teleop.type=roboneuron",
            "--teleop.robot=so101",
            "--fps=30",
            *options,
        )

    def lead(self, robot: str = "so101", *options: str) -> subprocess.Popen[str]:
        command = [sys.executable, str(LEADER), "--robot", robot, *options]
        return self._spawn(command, dict(os.environ))

    def _spawn(self, command: list[str], variables: dict[str, str]) -> subprocess.Popen[str]:
        path = self._folder / f"process-{len(self._running)}.log"
        with path.open("w", encoding="utf-8") as log:
            process = subprocess.Popen(
                command, stdout=log, stderr=subprocess.STDOUT, text=True, env=variables, cwd=ROOT
            )
        self._logs[process.pid] = path
        self._running.append(process)
        return process

    def told(self, process: subprocess.Popen[str]) -> str:
        """Output of a process so far."""
        return self._logs[process.pid].read_text(encoding="utf-8")

    def last_line(self, process: subprocess.Popen[str]) -> str:
        """The final sentence of a failed command of lerobot, below its traceback."""
        lines = [line for line in self.told(process).splitlines() if "Error: " in line]
        return lines[-1] if lines else self.told(process)[-2000:]

    def close(self) -> None:
        for process in reversed(self._running):
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(20)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


def serve(config: Path) -> str:
    """The option with which lerobot's process starts its own server."""
    command = Path(sys.executable).parent / "roboneuron"
    return f"--robot.serve=[{command}, serve, --config, {config}]"


def read_dataset(folder: Path, lerobot: Lerobot) -> dict[str, object]:
    """Contents of a data set, opened with lerobot in its environment."""
    done = subprocess.run(
        [str(BIN / "python"), str(Path(__file__).with_name("dataset_check.py")), str(folder)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env=lerobot.environment,
    )
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.splitlines()[-1]))


def release_stop(state: Path) -> None:
    """Confirm the release of the stop in a terminal, as a person does."""
    person, terminal = pty.openpty()
    try:
        os.write(person, b"y\n")
        command = [sys.executable, "-m", "roboneuron.cli.main", "estop", "--reset"]
        subprocess.run(
            [*command, "--state", str(state)],
            stdin=terminal,
            check=True,
            timeout=60,
            capture_output=True,
        )
    finally:
        os.close(person)
        os.close(terminal)
