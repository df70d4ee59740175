"""lerobot's own robots in a process of lerobot's environment, each with a simulated arm."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from rn_robot_lerobot.bus.arm import SerialArm, SerialKind
from rn_robot_lerobot.calibration import MotorCalibration
from rn_testing.waiting import wait_until

ROOT = Path(__file__).parents[3]
PYTHON = ROOT / ".venv-lerobot" / "bin" / "python"
PROCESS = Path(__file__).parent / "own_lerobot"
NEEDED = pytest.mark.skipif(
    not list(ROOT.glob(".venv-lerobot/lib/*/site-packages/dynamixel_sdk")),
    reason="lerobot's environment is not there: make test-lerobot-robots",
)


def children(pid: int) -> list[int]:
    """Children of a process."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                stat = (entry / "stat").read_text(encoding="utf-8")
            except (FileNotFoundError, ProcessLookupError):  # it has just ended
                continue
            if int(stat.rpartition(")")[2].split()[1]) == pid:
                found.append(int(entry.name))
    return found


class DriverError(Exception):
    """An error raised by the driver."""


class Process:
    """Runs drivers one after the other in a process that imports lerobot once."""

    def __init__(self, process: subprocess.Popen[str], log: Path) -> None:
        self._process, self._log = process, log
        self._lock = threading.Lock()
        self.pid = process.pid

    def __call__(self, name: str, *arguments: object) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with self._lock:
            with suppress(BrokenPipeError):  # it has ended, and its answer is empty
                self._process.stdin.write(json.dumps([name, *arguments]) + "\n")
                self._process.stdin.flush()
            line = self._process.stdout.readline()
        if not line:
            words = self._log.read_text(encoding="utf-8", errors="replace")[-2000:]
            pytest.fail(f"The process ended at {name!r} with {self._process.wait(10)}: {words}")
        answer = json.loads(line)
        if "error" in answer:
            raise DriverError(f"{answer['error']}: {answer['message']}")
        return answer["answer"]

    def fault(self) -> str:
        return str(self("read")["fault"])


@contextmanager
def process_with(log: Path, folder: Path = PROCESS) -> Iterator[Process]:
    """A process that also imports modules from a folder."""
    command = [str(PYTHON), str(PROCESS / "driver_process.py")]
    environment = {**os.environ, "PYTHONPATH": str(folder), "HF_HUB_OFFLINE": "1"}
    with (
        log.open("w") as errors,
        subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=environment,
        ) as process,
    ):
        try:
            yield Process(process, log)
        finally:
            process.kill()


class Cell:
    """An arm behind a port, and a driver for it."""

    def __init__(self, kind: SerialKind, folder: Path, driver: Process, stack: ExitStack) -> None:
        robot = kind.assembled.arm
        self.home_rad = robot.home_rad
        self.folder, self.name, self.driver = folder, robot.name, driver
        self.arm = stack.enter_context(SerialArm(kind))
        self.write_calibration(kind.assembled.calibration())
        # an answer may take longer than from a real motor, see BUSY_MS
        self.options = {"port": self.arm.port, "calibration_dir": str(folder), "silence_s": 1.0}
        driver("new", self.name, self.options)

    def write_calibration(self, calibration: dict[str, MotorCalibration]) -> None:
        text = json.dumps({name: asdict(motor) for name, motor in calibration.items()})
        (self.folder / f"{self.name}.json").write_text(text, encoding="utf-8")

    def turn(self) -> float:
        """Start a long rotation; return the current time [monotonic s]."""
        begun_rad = self.arm.position[0]
        self.driver("send", {"shoulder_pan": begun_rad + 0.8}, 4.0)
        wait_until(lambda: self.arm.position[0] > begun_rad + 0.1, 30.0, "the arm to turn")
        return time.monotonic()
