"""The commands of docs/two-machines.md, typed unchanged on two machines (network namespaces), until
the policy on the other machine moves the simulated arm. Needs root.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from link_machines import Machine, Talker, impossible, machines

from rn_backend_openpi.server_options import PolicyServerOptions
from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "two-machines.md").read_text(encoding="utf-8")
WATCHER = ROOT / "plugins" / "rn-link" / "tests" / "link_watcher.py"
MOVED_RAD = 0.03


def commands() -> list[tuple[str, str]]:
    """Machine and command, in the order of the page."""
    found = re.findall(r"(?m)^(robot|gpu)\$ (.+?)(?:\s+#.*)?$", PAGE)
    assert len(found) == 10, "the page promises ten"
    return found


def file_of(words: str) -> str:
    """The TOML that follows this text on the page."""
    match = re.search(rf"{re.escape(words)}.*?\n\n```toml\n(.*?)```", PAGE, re.DOTALL)
    assert match is not None, f"{words} is not followed by a file"
    return match[1]


class Terminal:
    """Types commands on a machine, in its own home directory; closing it ends all its processes."""

    def __init__(self, machine: Machine, address: str) -> None:
        self.machine = machine
        machine.run("ip", "addr", "add", f"{address}/24", "dev", "cable")
        home = machine.state
        machine.run("mount", "-t", "tmpfs", "tmpfs", "/run")
        self._environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")},
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "HOME": str(home),
            "XDG_STATE_HOME": str(home),
            "XDG_CONFIG_HOME": str(home / "config"),
            "XDG_RUNTIME_DIR": "/run",
            "COLUMNS": "200",
        }
        self._running: list[subprocess.Popen[bytes]] = []
        self._logs: list[Path] = []

    def type(
        self,
        command: str,
        *,
        answer: str = "",
        folder: Path | None = None,
        accepted: tuple[int, ...] = (0,),
    ) -> str:
        """Output of a command that ends by itself, with one of the `accepted` statuses."""
        done = subprocess.run(
            self.machine.inside(
                "sh", "-c", f"cd {shlex.quote(str(folder or self.machine.state))}; {command}"
            ),
            env=self._environment,
            input=answer,
            capture_output=True,
            text=True,
            timeout=240.0,
            check=False,
        )
        assert done.returncode in accepted, f"{command}\n{done.stdout}{done.stderr}{self.said()}"
        return done.stdout

    def leave(self, command: str) -> Path:
        """Start a command that keeps running; returns the file with its output."""
        log = self.machine.state / f"said-{len(self._logs)}.log"
        self._logs.append(log)
        with log.open("wb") as file:
            process = subprocess.Popen(
                self.machine.inside(
                    "sh", "-c", f"cd {shlex.quote(str(self.machine.state))}; exec {command}"
                ),
                env={**self._environment, "PYTHONUNBUFFERED": "1"},
                stdout=file,
                stderr=file,
            )
        self._running.append(process)
        return log

    def said(self) -> str:
        """The end of the output of all commands that keep running."""
        return "".join(f"\n{log.name}: {log.read_text()[-2000:]}" for log in self._logs)

    def close(self) -> None:
        """Press Ctrl-C in each terminal."""
        for process in self._running:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in self._running:
            try:
                process.wait(60.0)
            finally:
                process.kill()
                process.wait(10.0)


@contextmanager
def terminals(tmp_path: Path) -> Iterator[Mapping[str, Terminal]]:
    """Both machines; the robot's has the address given on the page."""
    named = re.search(r"--join ([0-9.]+)", PAGE)
    assert named is not None
    others = named[1].rpartition(".")[0] + ".77"
    with machines(tmp_path, "robot", "gpu") as both, ExitStack() as stack:
        made = {}
        for name, address in (("robot", named[1]), ("gpu", others)):
            made[name] = Terminal(both[name], address)
            stack.callback(made[name].close)
        yield made


def check_it_installs(terminal: Terminal, command: str) -> None:
    """Check that pip finds everything: packages of the source folder with their requirements, and
    packages of an index that this environment has already.
    """
    offline = "--dry-run --no-index --no-build-isolation"
    said = terminal.type(
        command.replace("pip install", f"{shlex.quote(sys.executable)} -m pip install {offline}"),
        folder=ROOT,
    )
    assert "Would install" in said


def moved_rad(watcher: Talker, since: list[float]) -> float:
    """Distance of the joint that has moved most [rad]."""
    positions = watcher.report().get("positions") or since
    return float(np.abs(np.array(positions) - np.array(since)).max(initial=0.0))


def inference_of(terminal: Terminal) -> dict[str, Any]:
    """Status of the inference module from `roboneuron status`."""
    # 1: a module reports a problem, as control does on a busy machine
    (server,) = json.loads(terminal.type("roboneuron status --json", accepted=(0, 1)))
    found = [one for one in server["modules"] if one["module"] == "inference"]
    return found[0] if found else {}


def test_the_ten_commands_move_an_arm_by_the_policy_of_the_other_machine(tmp_path: Path) -> None:
    with terminals(tmp_path) as made:
        robot, gpu = made["robot"], made["gpu"]
        (robot.machine.state / "roboneuron.toml").write_text(file_of("`roboneuron.toml`"))
        code = ""
        for name, command in commands():
            terminal = made[name]
            if command.startswith("pip install"):
                check_it_installs(terminal, command)
            elif " link add " in command:
                log = terminal.leave(command)
                wait_until(lambda log=log: "Code:" in log.read_text(), 30.0, "a code")
                shown = re.search(r"Code: (\d{3} \d{3})", log.read_text())
                assert shown is not None
                code = shown[1]
            elif " --join " in command:
                assert "a member of" in terminal.type(command, answer=f"{code}\n")
            elif command.endswith("status --config policy/policies.toml"):
                wait_until(
                    lambda there=terminal, typed=command: " ready " in there.type(typed),
                    120.0,
                    f"the model is ready: {terminal.said()}",
                )
            elif " policy serve " in command:
                log = terminal.leave(command)
                wait_until(
                    lambda log=log: "Robots connect to 0.0.0.0:7420" in log.read_text(),
                    60.0,
                    f"the server says where it listens: {terminal.said()}",
                )
            elif " up " in command:
                log = terminal.leave(command)
            else:
                terminal.type(command)
        watcher = robot.machine.talk("watcher", script=WATCHER)
        wait_until(lambda: watcher.report().get("positions"), 120.0, f"an arm: {robot.said()}")
        begun = watcher.report()["positions"]
        wait_until(
            lambda: moved_rad(watcher, begun) > MOVED_RAD,
            120.0,
            f"the arm moves: {robot.said()}{gpu.said()}",
        )
        wait_until(
            lambda: inference_of(robot)["metrics"].get("fallback.acting") == "shared",
            60.0,
            f"by the policy there: {inference_of(robot)}",
        )
        answered = inference_of(robot)["metrics"]
        assert float(answered["backend.shared.link_ms"]) >= 0.0
        check_the_fallback_acts(robot, gpu)


def check_the_fallback_acts(robot: Terminal, gpu: Terminal) -> None:
    """When the other machine is out of reach, the fallback named on the page acts, with the same
    instruction.
    """
    gpu.machine.cut()
    wait_until(
        lambda: inference_of(robot)["metrics"].get("fallback.acting") == "servo",
        60.0,
        f"the fallback acts: {inference_of(robot)}",
    )
    before = inference_of(robot)["published"]
    wait_until(
        lambda: inference_of(robot)["published"] > before + 5,
        60.0,
        f"it plans for the instruction: {inference_of(robot)}",
    )
    assert "servo acts in place of shared" in inference_of(robot)["note"]


def test_the_file_for_a_model_of_ones_own_is_one_that_the_server_takes() -> None:
    served = PolicyServerOptions.model_validate(
        tomllib.loads(file_of("Your own model in `policies.toml`"))
    )
    assert served.listen.host == "0.0.0.0"
    assert list(served.models) == ["oft"]
