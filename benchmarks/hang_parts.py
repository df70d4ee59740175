"""Parts of `hang_matrix`: a client of a served arm, and what makes a process hang."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
from lost_cell import FR3, KINDS

from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch
from roboneuron.gate.audit import AuditLog
from roboneuron.hang_watch import END_SIGNAL

BOUND_S = 3.0
REST_S = 3.0
"""docs/fault-matrix.md: timeouts of 0.25 to 2 s (`server_timeout_s`), and the braking."""
ENDED_S = 25.0
"""The bound while something loads, the stop of a module, and a busy machine."""
START_S = 120.0
TOLD = ("nothing", "SIGTERM", "SIGINT", "SIGUSR1", "stdin", "parent", "estop")
STOPPED_S = 0.6
"""The command `roboneuron estop` presses the latch file, which modules look at every 20 ms."""
PROCESSES = ("server", *KINDS, "recorder", "view", "twin", "policy front", "policy model")
NEVER = {"kind": "tcp_in", "lower_m": [9, 9, 9], "upper_m": [10, 10, 10]}
CONFIG = (
    FR3
    + """
[supervisor]
state_directory = "{folder}/state"
start_timeout_s = 120.0
hang_timeout_s = {bound}
[ops.restart]
perception = "never"
"""
)
HOOK = f'''"""Hangs this process once a file with its number appears."""
import ctypes, os, threading, time

def hang():
    sleep = ctypes.PyDLL(None).sleep
    path = os.path.join(os.environ["HANG_FOLDER"], str(os.getpid()))
    while not os.path.exists(path):
        time.sleep(0.02)
    os.rename(path, path + ".hangs")
    sleep(100)

if "HANG_FOLDER" in os.environ:
    from roboneuron import hang_watch
    hang_watch.LOADING_S = {3 * BOUND_S}
    threading.Thread(target=hang, daemon=True).start()
'''
PARENT = """
import subprocess, sys
child = subprocess.Popen(sys.argv[2:], pass_fds=[int(n) for n in sys.argv[1].split(",") if n])
print(child.pid, file=sys.stderr, flush=True)
sys.exit(child.wait())
"""


class HungClient:
    """A minimal client of a server on pipes, whose parent is a process of its own."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        command = [sys.executable, "-m", "roboneuron.cli.main", "serve"]
        command += ["--config", str(folder / "roboneuron.toml"), "--log-level", "warning"]
        self.log = (folder / "server.log").open("ab")
        self.begun_s = time.monotonic()
        self.parent = subprocess.Popen(
            [sys.executable, "-c", PARENT, "", *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            env=environment,
        )
        self._answers: dict[int, Any] = {}
        self._came = threading.Condition()
        self._number = 0
        self._is_ended = False
        threading.Thread(target=self._read, daemon=True).start()
        self.process = until(self._server, 20.0, "the server")

    def _server(self) -> psutil.Process | None:
        with contextlib.suppress(psutil.NoSuchProcess):
            return next(iter(psutil.Process(self.parent.pid).children()), None)
        return None

    def _read(self) -> None:
        assert self.parent.stdout is not None
        for line in self.parent.stdout:
            message = json.loads(line)
            with self._came:
                self._answers[message.get("id", -1)] = message
                self._came.notify_all()
        with self._came:
            self._is_ended = True
            self._came.notify_all()

    def send(self, method: str, params: dict[str, Any], **rest: Any) -> None:
        line = json.dumps({"jsonrpc": "2.0", "method": method, "params": params, **rest})
        assert self.parent.stdin is not None
        self.parent.stdin.write(line.encode() + b"\n")
        self.parent.stdin.flush()

    def request(self, method: str, params: dict[str, Any], timeout_s: float = START_S) -> Any:
        self._number += 1
        number = self._number
        self.send(method, params, id=number)
        with self._came:
            self._came.wait_for(lambda: number in self._answers or self._is_ended, timeout_s)
            if number not in self._answers:
                raise TimeoutError(f"{method} {params.get('name', '')} was not answered")
            return self._answers.pop(number)

    def begin(self) -> None:
        self.request(
            "initialize",
            {
                "protocolVersion": "2025-06-18",
                "capabilities": {},
                "clientInfo": {"name": "hang", "version": "1"},
            },
        )
        self.send("notifications/initialized", {})

    def ask(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """The result of a tool, errors included."""
        answer = self.request("tools/call", {"name": tool, "arguments": arguments})
        return dict(answer.get("result", answer))

    def modules(self) -> dict[str, dict[str, Any]]:
        told = self.ask("get_status")["structuredContent"]["modules"]
        return {module["module"]: module for module in told}

    def run_all(self) -> None:
        modules = self.modules()
        for kind in KINDS:
            if modules[kind]["phase"] != "running":
                answer = self.ask(f"start_{kind}")
                if answer.get("isError"):
                    raise RuntimeError(f"the next start of {kind}: {answer['content']}")

    def close(self) -> None:
        with contextlib.suppress(OSError, psutil.Error):
            self.parent.stdin.close()  # type: ignore[union-attr]
            self.process.wait(30.0)
        with contextlib.suppress(psutil.Error):
            self.process.kill()
        self.parent.kill()
        self.parent.wait(10.0)
        self.log.close()


def until(look: Callable[[], Any], timeout_s: float, what: str) -> Any:
    """The first true result."""
    end_s = time.monotonic() + timeout_s
    while not (found := look()):
        if time.monotonic() > end_s:
            raise TimeoutError(f"{what} did not come within {timeout_s:g} s")
        time.sleep(0.02)
    return found


def alive(pid: int) -> bool:
    with contextlib.suppress(psutil.NoSuchProcess):
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    return False


def is_watched(pid: int) -> bool:
    """True if it handles the signal of its watch: not before its first imports."""
    status = Path(f"/proc/{pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (END_SIGNAL - 1) & 1)


class Hangs:
    """Hangs processes, and tells them something."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "hangs"
        self.folder.mkdir(exist_ok=True)

    def hang(self, pid: int) -> float:
        """Returns the monotonic time from which on it hangs [s]."""
        until(lambda: is_watched(pid), 60.0, "the watch")
        (self.folder / str(pid)).touch()
        until((self.folder / f"{pid}.hangs").exists, 20.0, "the hang")
        hung_s = time.monotonic()
        time.sleep(0.2)
        return hung_s

    @staticmethod
    def tell(pid: int, told: str, parent: int, close: Callable[[], object]) -> None:
        if told.startswith("SIG"):
            os.kill(pid, signal.Signals[told])
        elif told == "stdin":
            close()
        elif told == "parent":
            os.kill(parent, signal.SIGKILL)


def press(folder: Path, environment: dict[str, str]) -> float:
    """Stop with the command line; returns the monotonic time at which the file was there [s]."""
    command = [sys.executable, "-m", "roboneuron.cli.main", "estop"]
    command += ["--config", str(folder / "roboneuron.toml")]
    pressed = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    until(lambda: any((folder / "state").rglob(ESTOP_FILE)), 30.0, "the latch file")
    found_s = time.monotonic()
    if pressed.wait(30.0) != 0:
        raise RuntimeError(f"roboneuron estop ended with {pressed.returncode}")
    return found_s


def release(folder: Path) -> None:
    """Release the stop, as a person does."""
    for path in (folder / "state").rglob(ESTOP_FILE):
        with contextlib.closing(AuditLog(folder / "release.jsonl", time.time_ns)) as audit:
            latch = EmergencyStopLatch(path, time.time_ns)
            latch.is_latched()
            latch.reset(who="hang", role="admin", audit=audit)


def whole(state: Path) -> list[str]:
    """Problems of latch and audit."""
    problems = []
    for path in state.rglob("audit.jsonl"):
        for line in path.read_text().splitlines():
            try:
                json.loads(line)
            except ValueError:
                problems.append(f"the audit is damaged: {line[:80]}")
    for path in state.rglob("emergency_stop.latched"):
        if path.exists():
            problems.append("the latch is pressed, but nobody pressed it")
    return problems


def words(pid: int) -> str:
    with contextlib.suppress(psutil.Error):
        return " ".join(psutil.Process(pid).cmdline())
    return ""
