"""Shared helpers for tests of processes that are shells."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rn_testing.waiting import wait_until
from roboneuron.supervisor.process import ModuleProcess

SOON_S = 10.0
"""Milliseconds on an idle machine."""
ENVIRONMENT = {"PATH": os.environ["PATH"], "ROBOT": "pair"}
START = "read line; echo up; "
"""Once this shell has written `up`, its traps are set."""
Spawn = Callable[..., ModuleProcess]


def end_now(process: ModuleProcess) -> None:
    """Kill without Popen, which would reap it in place of its reaper."""
    if process.exit_code is None:
        for end in (os.killpg, os.kill):
            with suppress(OSError):
                end(process.pid, signal.SIGKILL)
    process.wait(1.0)


def await_line(path: Path, line: str) -> None:
    wait_until(
        lambda: path.exists() and line in path.read_text().splitlines(), SOON_S, f"no line {line}"
    )


def state_of(pid: int) -> str:
    """State letter of proc(5); also Z if the process no longer exists."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


def child_of(path: Path) -> int:
    """The pid that a script has written after `child `."""
    wait_until(lambda: path.exists() and "child " in path.read_text(), SOON_S, "no child")
    return int(path.read_text().partition("child ")[2].split()[0])
