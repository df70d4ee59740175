"""Many light bases behind one server: commands lost, time of a fleet stop, and what a killed robot
does to the others.

    python benchmarks/bench_fleet.py [--robots 16] [--minutes 10] [--stops 100] [--parts stops
    drive] [--out ROWS]

The two parts can be measured apart, for a machine that is quiet for minutes only: 40 stops take
about a minute, the driving takes the minutes it is given. `--out` keeps a row of JSON for each stop
and each sequence as it ends, with the load of the machine; stops that it has already are not made
again.

Each robot is a `[robots.<name>]` with a robot process of its own whose driver notes when each
command arrives (`fleet_plugin.py`); nothing is simulated. All are driven at once by one client over
stdio, by sequences of numbered velocities at 10 Hz, 10 s each.

- lost: numbers that the tool said it sent and that the base never noted, of robots that were not
  killed.
- stop: from the call of emergency_stop (all robots) until the last robot was commanded to stand,
  while all drive: by the server's zero command, or by its own module, which reads the latch and
  then refuses all commands.
- killed: half way one robot process is killed (SIGKILL). Lateness of a command is its arrival
  against the sequence's own clock (its number times 0.1 s), counted from the earliest command of
  that sequence. p99 of the others after the kill is held against p99 before.

Judged: nothing lost; stop at most 50 ms (median) and every base stopped in every stop; p99 ratio at
most 1.10. Times are of one host with one clock (CLOCK_MONOTONIC).
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import anyio
from fleet_bases import SPEED_M_S, STEP_S, Base, write_configuration
from fleet_report import ZERO_S, Found, report
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client
from plugin_site import installed

from rn_standard.demo.agent import DemoAgent, module_status
from roboneuron import RoboNeuronError
from roboneuron.ros.environment import prepare_environment

MOST_STEPS = 100
CALL_S, START_S, DRIVE_S = 180.0, 600.0, 30.0
POLL_S = 0.005
PARTS = ("stops", "drive")
AT_ONCE = 4
"""Robots started at the same time: each start imports rclpy, which takes a core a second."""


async def start(agent: DemoAgent, bases: Iterable[Base]) -> None:
    """Start all robot processes, a few at a time."""
    limit = anyio.CapacityLimiter(AT_ONCE)

    async def one(base: Base) -> None:
        async with limit:
            await agent.call("start_robot", {"robot": base.name})
        status = await agent.call("get_status", {"robot": base.name})
        base.pid = int(module_status(status, "robot")["pid"])

    with anyio.fail_after(START_S):
        async with anyio.create_task_group() as tasks:
            for base in bases:
                tasks.start_soon(one, base)


async def until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """True if the condition came true in time."""
    end_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end_s:
            return False
        await anyio.sleep(POLL_S)
    return True


class Rows:
    """Measurements as lines of JSON, stored in a file if one is given."""

    def __init__(self, path: Path | None, robots: int) -> None:
        self._path = path
        self._robots = robots
        lines = path.read_text().splitlines() if path is not None and path.exists() else []
        self.before = [row for row in map(json.loads, lines) if row["robots"] == robots]
        """Rows of earlier runs with the same number of robots."""

    def add(self, part: str, **facts: Any) -> None:
        """Append a row, with the load of the last minute."""
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            row = {
                "part": part,
                "robots": self._robots,
                "load": round(os.getloadavg()[0], 2),
                **facts,
            }
            with self._path.open("a") as file:
                file.write(json.dumps(row) + "\n")


async def stop_once(agent: DemoAgent, bases: list[Base]) -> list[float | None]:
    """Drive all, stop all, release all; returns ms until each base was commanded to stand, None for
    one that was not.
    """
    before = {base.name: base.count() for base in bases}

    async def drive(base: Base) -> None:
        message = {"linear": {"x": SPEED_M_S}}
        try:
            await agent.call(
                "publish_velocity", {"robot": base.name, "message": message, "duration_s": DRIVE_S}
            )
        except RoboNeuronError:
            return  # it was stopped, as it should be
        base.failures.append("a motion went on to its end in spite of the emergency stop")

    def zero_ns(base: Base, since_ns: int) -> int | None:
        return next(
            (at for at, x, _ in base.arrivals(before[base.name]) if at > since_ns and x == 0.0),
            None,
        )

    async with anyio.create_task_group() as tasks:
        for base in bases:
            tasks.start_soon(drive, base)
        if not await until(
            lambda: all(base.count() > before[base.name] for base in bases), DRIVE_S
        ):
            raise SystemExit("Some base got no command within 30 s.")
        await anyio.sleep(0.3)  # not during the initial burst
        stopped_ns = time.monotonic_ns()
        try:
            await agent.call("emergency_stop", {"reason": "benchmark"})
        except (
            RoboNeuronError
        ) as error:  # a module did not confirm it in time, but its base may stand all the same
            print(error, file=sys.stderr)
        await until(lambda: all(zero_ns(base, stopped_ns) is not None for base in bases), ZERO_S)
    zeros = [zero_ns(base, stopped_ns) for base in bases]
    async with anyio.create_task_group() as tasks:
        for base in bases:
            tasks.start_soon(agent.call, "reset_emergency_stop", {"robot": base.name})
    return [None if zero is None else (zero - stopped_ns) / 1e6 for zero in zeros]


async def drive_for(agent: DemoAgent, base: Base, begin_s: float, end_s: float, rows: Rows) -> None:
    """Run sequences until the time is over; robots start one after the other, not all at once."""
    await anyio.sleep(begin_s)
    while (left_s := end_s - time.monotonic()) > 1.0:
        steps = max(1, min(MOST_STEPS, round(left_s / STEP_S)))
        first, arguments = base.sequence(steps)
        before = base.count()
        try:
            done = await agent.call("publish_velocity_sequence", arguments)
        except RoboNeuronError as error:
            base.failures.append(str(error))
            return
        base.told.append((first, first + steps - 1))
        sent = done["sent"]
        assert isinstance(sent, int)  # guaranteed by the tool's output schema
        base.published += sent
        came = {number for _, x, number in base.arrivals(before) if x}
        missing = sum(number not in came for number in range(first, first + steps))
        rows.add("drive", robot=base.name, first=first, last=first + steps - 1, missing=missing)


async def measure(path: Path, bases: list[Base], arguments: argparse.Namespace, log: Path) -> Found:
    """Start, stop many times, then drive with one robot killed halfway."""
    rows = Rows(arguments.out, len(bases))
    found = Found(
        victim=bases[-1].name, stops_ms=[row["ms"] for row in rows.before if row["part"] == "stop"]
    )
    print(f"load {os.getloadavg()[0]:.1f}, {len(found.stops_ms)} stops are known", flush=True)
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(path)]
    server = StdioServerParameters(command=sys.executable, args=words, env=dict(os.environ))
    with log.open("w") as errors:
        async with Client(
            stdio_client(server, errlog=errors), read_timeout_seconds=CALL_S
        ) as client:
            agent = DemoAgent(client)
            begun_s = time.monotonic()
            await start(agent, bases)
            found.started_s = time.monotonic() - begun_s
            print(f"{len(bases)} robots started in {found.started_s:.1f} s", flush=True)
            if "stops" in arguments.parts:
                with anyio.fail_after(arguments.stops * CALL_S + 1.0):
                    while len(found.stops_ms) < arguments.stops:
                        each_ms = await stop_once(agent, bases)
                        known = [ms for ms in each_ms if ms is not None]
                        found.stops_ms.append(max(known) if len(known) == len(bases) else None)
                        rows.add(
                            "stop",
                            ms=found.stops_ms[-1],
                            each_ms=[round(ms, 2) for ms in sorted(known)],
                        )
                        if len(found.stops_ms) % 10 == 0:
                            print(f"{len(found.stops_ms)} stops", flush=True)
            if "drive" not in arguments.parts:
                return found
            end_s = time.monotonic() + 60.0 * arguments.minutes
            with anyio.fail_after(60.0 * arguments.minutes + CALL_S):
                async with anyio.create_task_group() as tasks:
                    for index, base in enumerate(bases):
                        tasks.start_soon(
                            drive_for, agent, base, index * STEP_S / len(bases), end_s, rows
                        )
                    await anyio.sleep(30.0 * arguments.minutes)
                    os.kill(bases[-1].pid, signal.SIGKILL)
                    found.killed_ns = time.monotonic_ns()
            await anyio.sleep(0.5)  # the last sent messages arrive
    return found


def main() -> int:
    """Measure and print; status 1 if a bound does not hold."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="of driving; half of it before the kill"
    )
    parser.add_argument("--stops", type=int, default=100)
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=list(PARTS), help="measure these only"
    )
    parser.add_argument("--out", type=Path, help="rows as they come; stops in it are known")
    parser.add_argument(
        "--folder", type=Path, help="keep configuration, notes and logs here; it must be empty"
    )
    arguments = parser.parse_args()
    if arguments.robots < 2 or arguments.minutes <= 0 or arguments.stops < 0:
        parser.error("at least two robots, more than no minutes, no negative stops")
    with ExitStack() as stack:
        folder = arguments.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        stack.enter_context(installed(folder, "fleet-benchmark", ("fleet_plugin",)))
        prepare_environment(folder / "ros")
        bases = [
            Base(f"r{number:02}", folder / f"r{number:02}.notes")
            for number in range(arguments.robots)
        ]
        path = write_configuration(folder, bases)
        found = anyio.run(measure, path, bases, arguments, folder / "server.log")
        return report(found, bases)


if __name__ == "__main__":
    sys.exit(main())
