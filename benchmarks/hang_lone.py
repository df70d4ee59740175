"""A process that needs no arm and hangs, for `hang_matrix`: a view, a twin, a policy server."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
from hang_parts import BOUND_S, ENDED_S, PARENT, TOLD, Hangs, alive, until, words

from roboneuron.answering_process import COMMAND


def lone_commands(folder: Path) -> dict[str, list[str]]:
    """Command lines of processes that need no arm."""
    policies = folder / "policies.toml"
    token = folder / "token"
    token.write_text("0123456789abcdef0123456789abcdef\n")
    token.chmod(0o600)
    policies.write_text(
        f'[listen]\nport = 0\nhost = "127.0.0.1"\ndirectory = "{folder}/policy"\n'
        f'keys = "token"\ntoken_file = "{token}"\n'
        '[models.servo]\nbackend = "servo"\nstateless = true\n'
    )
    view = [sys.executable, "-m", "roboneuron.cli.main", "view", "--port", "0"]
    return {
        "view": [*view, "--config", str(folder / "roboneuron.toml")],
        "twin": list(COMMAND),
        "policy front": [
            *(sys.executable, "-m", "roboneuron.cli.main", "policy", "serve"),
            *("--config", str(policies)),
        ],
    }


def lone_trial(
    folder: Path, hangs: Hangs, environment: dict[str, str], process: str, phase: str, told: str
) -> dict[str, Any]:
    """A process that needs no arm."""
    problems: list[str] = []
    command = lone_commands(folder)["policy front" if process.startswith("policy") else process]
    log = (folder / "lone.log").open("ab")
    descriptors = ""
    pipes: tuple[int, ...] = ()
    if process == "twin":
        own, theirs = socket.socketpair()
        descriptors, pipes = str(theirs.fileno()), (theirs.fileno(),)
        command = [*command, descriptors]
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, descriptors, *command],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        pass_fds=pipes,
        env={**environment, "ROBONEURON_HANG_TIMEOUT_S": f"{BOUND_S}"},
    )
    made = psutil.Process(parent.pid)
    pid = until(lambda: next((c.pid for c in made.children()), 0), 20.0, process)
    if process == "policy model":
        pid = until(
            lambda: next(
                (c.pid for c in made.children(recursive=True) if "server_process" in words(c.pid)),
                0,
            ),
            60.0,
            process,
        )
    time.sleep(0.5 if phase == "start" else 6.0)
    hung_s = hangs.hang(pid)
    of_model = process == "policy model"
    of = psutil.Process(pid).ppid() if of_model else parent.pid
    closing = (lambda: os.kill(of, signal.SIGKILL)) if of_model else parent.stdin.close  # type: ignore[union-attr]
    if process == "twin":
        theirs.close()
        closing = own.close
    hangs.tell(pid, told, of, closing)
    ends: dict[str, Any] = {}
    try:
        until(lambda: not alive(pid), ENDED_S, "the end")
        ends["ended_s"] = round(time.monotonic() - hung_s, 2)
    except TimeoutError as error:
        problems.append(str(error))
        os.kill(pid, signal.SIGKILL)
    if of_model and told in TOLD[:4]:

        def again() -> bool:
            return any(
                "server_process" in words(c.pid) and c.pid != pid
                for c in made.children(recursive=True)
            )

        try:
            until(again, 30.0, "the next start")
        except (TimeoutError, psutil.NoSuchProcess) as error:
            problems.append(str(error))
    with contextlib.suppress(psutil.NoSuchProcess):
        for child in made.children(recursive=True):
            child.terminate()
        psutil.wait_procs(made.children(recursive=True), 10.0)
    parent.kill()
    parent.wait(10.0)
    log.close()
    return {"process": process, "phase": phase, "told": told, **ends, "problems": problems}
