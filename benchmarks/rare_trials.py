"""One worker of `rare_faults`: makes a cell, repeats one fault, and prints a line of JSON for each
trial.

python benchmarks/rare_trials.py FAULT TRIALS FOLDER
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from fault_loop import JointWitness, config_text, environment, moving_cell
from switch_loop import Witness, moving_loop

from rn_standard.selection.requests import StartControl
from rn_standard.switching.replacing import Switching
from rn_standard.tools_loop.instructing import give_instruction
from roboneuron.errors import RoboNeuronError
from roboneuron.server.loop import ClosedLoop

sys.path.pop(0)

GONE_S, MOVES_S, ANSWER_S = 15.0, 30.0, 60.0
"""Time limits: for server and modules to end after their client's death, for the arm to move again,
and for a tool call to return.
"""
LONGEST_START_S = 2.5
"""The client is killed at a random time between 0 and this after its request to start control."""
SWITCH_RATE_HZ = 30.0
GOOD = frozenset(
    {"all gone", "the start was over, all gone", "moved again", "switched", "switched, one missed"}
)
"""Outcomes that are not faults."""
Trial = Callable[[], dict[str, Any]]
CLIENT = """
import json, os, subprocess, sys, threading
server = subprocess.Popen(json.loads(sys.argv[1]), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                          stderr=open(sys.argv[2], "ab"))
def send(**message):
    server.stdin.write(json.dumps({"jsonrpc": "2.0", **message}).encode() + b"\\n")
    server.stdin.flush()
def answer(number):
    for line in server.stdout:
        message = json.loads(line)
        if message.get("id") == number and "method" not in message:
            return message
send(id=1, method="initialize", params={"protocolVersion": "2025-06-18", "capabilities": {},
     "clientInfo": {"name": "mortal", "version": "1"}})
answer(1)
send(method="notifications/initialized")
for number, tool in enumerate(sys.argv[3:], 2):
    print(tool, flush=True)
    send(id=number, method="tools/call", params={"name": tool, "arguments": {}})
    said = answer(number)
    print(json.dumps(said)[:400], flush=True)
"""
"""A client that only uses pipes: it starts its server, calls the tools, and waits to be killed."""


def main() -> None:
    """Run the trials and print the outcome of each."""
    fault, trials, folder = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
    wire = os.dup(1)
    os.dup2(2, 1)  # everything else that is printed goes to the log
    with TRIALS[fault](folder) as trial:
        for _ in range(trials):
            started_s = time.monotonic()
            result = trial()
            result.setdefault("took_s", time.monotonic() - started_s)
            os.write(wire, json.dumps(result).encode() + b"\n")


@contextmanager
def client_death(folder: Path) -> Iterator[Trial]:
    """A new server and client for each trial."""
    path = folder / "roboneuron.toml"
    with environment(folder):
        path.write_text(config_text(folder, 10.0))
        server = [sys.executable, "-m", "roboneuron.cli.main", "serve", "--config", str(path)]
        numbers = iter(range(10**6))
        yield lambda: _one_client_death(folder, server, next(numbers))


def _one_client_death(folder: Path, server: list[str], number: int) -> dict[str, Any]:
    mark = f"RARE_TRIAL={folder}/{number}"
    name, value = mark.split("=")
    tools = ["start_robot", "start_control"] if number % 2 else ["start_control"]
    client = subprocess.Popen(
        [
            sys.executable,
            "-S",
            "-c",
            CLIENT,
            json.dumps(server),
            str(folder / "server.log"),
            *tools,
        ],
        stdout=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        env=os.environ | {name: value},
    )
    watchdog = threading.Timer(ANSWER_S, client.kill)
    watchdog.start()
    assert client.stdout is not None
    asked = any(line.strip() == "start_control" for line in iter(client.stdout.readline, ""))
    if not asked:
        client.kill()
        client.wait(10)
        return {"outcome": "the server did not answer", "number": number, "left": _left(mark)}
    delay_s = random.uniform(0.0, LONGEST_START_S)
    time.sleep(delay_s)
    client.kill()
    killed_s = time.monotonic()
    said = client.stdout.read().strip()
    client.wait(10)
    watchdog.cancel()
    end_s = killed_s + GONE_S
    while (left := _left(mark)) and time.monotonic() < end_s:
        time.sleep(0.05)
    took_s = time.monotonic() - killed_s
    if not left:
        outcome = "the start was over, all gone" if said else "all gone"
        return {"outcome": outcome, "took_s": took_s, "number": number, "delay_s": delay_s}
    _describe(folder / f"left-{number}.txt", left)
    for pid in left:
        _signal(pid, signal.SIGKILL)
    return {
        "outcome": f"left {sorted(left.values())}",
        "number": number,
        "delay_s": delay_s,
        "said": said,
    }


def _left(mark: str) -> dict[int, str]:
    """Processes with this variable in their environment, by PID: "module" or "server"."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        try:
            if mark.encode() in (entry / "environ").read_bytes().split(b"\0"):
                is_module = b"roboneuron.modules" in (entry / "cmdline").read_bytes()
                found[int(entry.name)] = "module" if is_module else "server"
        except OSError:
            continue
    return found


def _describe(path: Path, pids: Mapping[int, str]) -> None:
    """Write the stacks and open files of the remaining processes."""
    with path.open("w", encoding="utf-8") as file:
        for pid, what in pids.items():
            file.write(f"== {what} {pid}\n")
            for descriptor in sorted(Path(f"/proc/{pid}/fd").glob("[012]")):
                file.write(f"{descriptor.name} -> {os.readlink(descriptor)}\n")
            file.flush()
            for task in Path(f"/proc/{pid}/task").iterdir():
                file.write(
                    f"{task.name} {(task / 'comm').read_text().strip()} "
                    f"{(task / 'wchan').read_text()}\n"
                )
            file.flush()
            # an optional tool that prints the Python stacks of another process
            spy = os.environ.get("PY_SPY")
            if spy:
                subprocess.run(
                    [spy, "dump", "--pid", str(pid)],
                    stdout=file,
                    stderr=file,
                    timeout=30,
                    check=False,
                )


def _signal(pid: int, number: int) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return


@contextmanager
def control_restart(folder: Path) -> Iterator[Trial]:
    """Make a moving cell whose control is killed and started again."""
    with moving_cell(folder, 30.0, backend="steady") as (loop, witness):
        yield lambda: _one_restart(loop, witness)


def _one_restart(loop: ClosedLoop, witness: JointWitness) -> dict[str, Any]:
    if not _wait(lambda: _moves_well(witness), MOVES_S):
        return {"outcome": "it did not move before", **_said(loop)}
    process = loop.modules.view("control").process
    assert process is not None
    time.sleep(random.uniform(0.0, 0.3))
    os.kill(process.pid, signal.SIGKILL)
    if not loop.modules.changes.wait_for(
        lambda: loop.modules.view("control").phase == "exited", MOVES_S
    ):
        return {"outcome": "its end was not noticed", **_said(loop)}
    time.sleep(random.choice((0.0, random.uniform(0.0, 1.5))))
    try:
        loop.start("control")
        give_instruction(loop, "swing", MOVES_S)  # a restart starts no motion
    except RoboNeuronError as error:
        first = _said(loop)
        if loop.modules.view("control").phase != "running":
            loop.start("control")
        give_instruction(loop, "swing", MOVES_S)
        return {"outcome": f"start failed: {type(error).__name__}", "error": str(error), **first}
    started_s = time.monotonic()
    if not _wait(lambda: _moves_well(witness), MOVES_S):
        return {"outcome": "did not move again", **_said(loop)}
    return {"outcome": "moved again", "took_s": time.monotonic() - started_s}


def _moves_well(witness: JointWitness) -> bool:
    """Whether the joint moved by more than 5 mm within the last 0.3 s."""
    recent = [x for at, x in witness.joints() if at > time.monotonic() - 0.3]
    return bool(recent) and max(recent) - min(recent) > 0.005


def _said(loop: ClosedLoop) -> dict[str, Any]:
    return {"said": {view.kind: f"{view.phase} {view.report}" for view in loop.modules.views()}}


def _wait(fact: Callable[[], bool], timeout_s: float) -> bool:
    deadline_s = time.monotonic() + timeout_s
    while not fact():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.02)
    return True


@contextmanager
def control_switch(folder: Path) -> Iterator[Trial]:
    """Make a moving loop whose controller is replaced warm, back and forth."""
    with moving_loop(folder, SWITCH_RATE_HZ) as (switching, witness):
        yield lambda: _one_switch(switching, witness)


def _one_switch(switching: Switching, witness: Witness) -> dict[str, Any]:
    loop = switching.loop
    witness.forget()
    seen: deque[str] = deque(maxlen=30)
    stages: list[str] = []
    over = threading.Event()

    def look() -> None:
        while not over.wait(0.1):
            for slot in loop.modules.slots["control"][1:]:
                seen.append(f"{time.time_ns()} new {slot.report}")
            seen.append(f"{time.time_ns()} old {loop.modules.view('control').report}")

    looking = threading.Thread(target=look)
    looking.start()
    plan = loop.modules.view("control").plan
    assert plan is not None
    other = "faulty" if plan.names["controller"] == "gantry" else "gantry"
    try:
        witness.more_actions(20, 20.0)
        switched = switching.switch(
            "control", StartControl(controller=other, options={}), "warm", stages.append
        )
    except (RoboNeuronError, TimeoutError) as error:
        return {
            "outcome": _words(str(error)),
            "error": str(error),
            "stages": stages,
            "seen": list(seen),
        }
    finally:
        over.set()
        looking.join(10.0)
    gap = switched.change.gap
    reports = [
        loop.modules.view(kind).report for kind in ("robot", "perception", "inference", "control")
    ]
    foreign = sum(
        report.dropped_by.get("foreign_request", 0) for report in reports if report is not None
    )
    if foreign:
        return {"outcome": "a request of the server counted as foreign", "seen": list(seen)}
    if gap is None:
        return {"outcome": "no gap is known", "seen": list(seen)}
    times = [at for at, _, _ in witness.commands()]
    between_s = [(b - a) / 1e9 for a, b in pairwise(times)]
    missed = sum(one > 1.5 / SWITCH_RATE_HZ for one in between_s)
    between_s.remove(min(between_s, key=lambda one: abs(one - gap.gap_s)))  # the switch itself
    actions = [action.at_ns for action in witness.actions()]
    without = sum(b - a > 1.5e9 / SWITCH_RATE_HZ for a, b in pairwise(actions))
    words = {0: "switched", 1: "switched, one missed"}.get(gap.missed, "switched, several missed")
    return {
        "outcome": words,
        "gap_periods": gap.gap_s / gap.period_s,
        "elsewhere_longest": max(between_s) / gap.period_s,
        "elsewhere_missed": (missed - (gap.missed > 0)) / max(1, len(times)),
        "actions_missed": without / max(1, len(actions)),
    }


def _words(text: str) -> str:
    """The text without its numbers, so that similar faults are counted together."""
    return " ".join("#" if any(c.isdigit() for c in word) else word for word in text.split())[:160]


TRIALS = {
    "client-death": client_death,
    "control-restart": control_restart,
    "control-switch": control_switch,
}
"""How to make the cell of each fault."""

if __name__ == "__main__":
    main()
