"""Sixteen robots on one policy server, one of them greedy: the share of each.

    python benchmarks/bench_serve_robots.py [--demand 0.4] [--seconds 20] [--replicas 1]
    python benchmarks/bench_serve_robots.py --demand 1.8 --connections 50

The model is small (one layer over mean colours) and takes at least 25 ms, like one on a GPU,
independent of the CPU load. It answers one by one, behind `roboneuron serve-policy` over TLS 1.3
with the keys of a link. Each robot is a backend `shared` with its own connection, four per process.
Each sends requests at `--demand` / n times the rate that the model achieves for one alone; the
greedy one (robot 0) sends the next request at once, with half the deadline. A robot executes eight
rows of a quarter of its period: rows due before their answer arrived are late, and all rows of a
period without an answer.

With `--connections` the greedy one is a client with that number of simultaneous connections. Robots
are then identified by their addresses, in 127.0.0.0/8, and send a token unencrypted.

Bounds: none of the others gets less than 0.75 times their median; under overload (`--demand` of 1.5
and more) the greedy one gets at most 1.25 times that.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from bench_serve_policy import pair, seen, started

from rn_backend_shared.backend import SharedBackend
from rn_backend_shared.case import install
from rn_backend_shared.channel import FrameChannel
from rn_backend_shared.options import SharedOptions
from rn_backend_shared.processes import ask_status
from rn_backend_shared.serve_command import name_of
from rn_backend_shared.session import ModelSession, greet
from rn_backend_shared.wire import from_observation
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError, Observation

MOST_SHARE, LEAST_SHARE, CROWDED = 1.25, 0.75, 1.5
ROWS_PLAYED, ROWS = 4, 8
"""Executed rows of each chunk, and rows in it."""
IN_A_PROCESS = 4
WARM = 20
SIDE = 64
MISSED = "missed: "
TOKEN = "ROBONEURON_BENCHMARK_TOKEN"
"""Environment variable of robots with a token."""
MOST_CONNECTIONS = 80


@dataclass
class Robot:
    """Answers to a robot.

    Attributes:
        name: 0 for the greedy one.
        took_s: time of each answer.
        refused: observations without an answer.
        late_rows: see above; out of `rows` that were due.
    """

    name: int
    took_s: list[float] = field(default_factory=list)
    refused: int = 0
    late_rows: int = 0
    rows: int = 0

    def note(self, took_s: float | None, step_s: float) -> None:
        """Count an answer, or a missing one."""
        self.rows += ROWS_PLAYED
        if took_s is None:
            self.refused += 1
            self.late_rows += ROWS_PLAYED
            return
        self.took_s.append(took_s)
        over_s = took_s - (ROWS - ROWS_PLAYED) * step_s
        self.late_rows += min(max(int(np.ceil(over_s / step_s)), 0), ROWS_PLAYED)


class Asker(Protocol):
    """Client interface of a robot."""

    def predict(self, observation: Observation) -> object:
        """The answer; raises NotReadyError without one in time."""

    def close(self) -> None:
        """Disconnect."""


class Connection:
    """A connection from its own address, with a token."""

    def __init__(self, source: str, address: str, token: str, timeout_s: float) -> None:
        host, _, port = address.rpartition(":")
        connected = socket.create_connection((host, int(port)), 60.0, (source, 0))
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        channel = FrameChannel(connected)
        self._session = ModelSession(channel, greet(channel, {"token": token}, 60.0))
        self._timeout_s = timeout_s

    def predict(self, observation: Observation) -> object:
        """See `Asker`."""
        try:
            document = from_observation(observation)
            return self._session.ask(document, time.monotonic() + self._timeout_s)
        except TimeoutError as error:
            raise NotReadyError("There is no answer in time.") from error

    def close(self) -> None:
        """See `Asker`."""
        self._session.close()


def asker_of(robot: Robot, address: str, timeout_s: float) -> Asker:
    """The client of a robot."""
    if token := os.environ.get(TOKEN):
        return Connection(f"127.0.1.{robot.name + 1}", address, token, timeout_s)
    options = SharedOptions(
        address=address, coding="raw", timeout_s=timeout_s, start_timeout_s=60.0
    )
    backend = SharedBackend(options)
    backend.load()
    return backend


def drive(robot: Robot, address: str, period_s: float, begin_s: float, seconds: float) -> None:
    """Send this robot's requests, from the monotonic time `begin_s` on."""
    is_greedy = robot.name == 0
    backend = asker_of(robot, address, period_s * (1.0 if is_greedy else 2.0))
    observation = seen(SIDE)
    next_s = begin_s + period_s * robot.name / 16
    end_s = begin_s + seconds
    try:
        while time.monotonic() < end_s:
            time.sleep(max(next_s - time.monotonic(), 0.0))
            asked_s = time.monotonic()
            took_s: float | None = None
            try:
                backend.predict(observation)
                took_s = time.monotonic() - asked_s
            except NotReadyError:
                pass
            robot.note(took_s, period_s / ROWS_PLAYED)
            next_s = time.monotonic() if is_greedy else max(next_s + period_s, time.monotonic())
    finally:
        backend.close()


JOIN_S = 120.0
"""Time from the start of a robot's thread to its end, besides the measured time."""


def drive_some(words: Sequence[str]) -> None:
    """Run the robots of one process; writes their answers to stdout."""
    names, address, period_s, begin_s, seconds = words
    robots = [Robot(int(name)) for name in names.split(",")]
    threads = [
        threading.Thread(
            target=drive, args=(robot, address, float(period_s), float(begin_s), float(seconds))
        )
        for robot in robots
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(float(seconds) + JOIN_S)
    if any(thread.is_alive() for thread in threads):
        raise SystemExit(f"A robot did not end within {JOIN_S:g} s.")
    print(json.dumps([asdict(robot) for robot in robots]))


def serve(stack: ExitStack, folder: Path, path: str, replicas: int, *, by_token: bool) -> str:
    """Start the server, and return its address."""
    config = folder / "policies.toml"
    keys = f'keys = "token"\ntoken_file = "{folder / "token"}"\n' if by_token else ""
    config.write_text(
        f'[listen]\nport = 0\nrobots = 100\ndirectory = "{folder / "run"}"\n{keys}[models.tiny]\n'
        f'backend = "reflex"\nmost = 1\nreplicas = {replicas}\n'
        "options = { took_s = 0.025, rows = 8 }\n"
    )
    log = stack.enter_context((folder / "server.log").open("w"))
    words = [sys.executable, "-m", "roboneuron.cli.main", "serve-policy", "--config", str(config)]
    own = {**os.environ, "PYTHONPATH": path, "XDG_STATE_HOME": str(folder / "gpu")}
    started(stack, words, env=own, stdout=log, stderr=log)
    told: dict[str, Any] = {}

    def is_ready() -> bool:
        try:
            told.update(ask_status(folder / "run" / f"{name_of(config)}.sock"))
        except NotReadyError:
            return False
        model = told["models"]["tiny"]
        return all(one["state"] == "ready" for one in model.get("replicas", [model]))

    wait_until(is_ready, 90.0, "the server is ready")
    return str(told["address"])


def forward_s(address: str) -> float:
    """Median time that the server takes for a robot alone [s]."""
    alone = Robot(1)
    backend = asker_of(alone, address, 30.0)
    observation = seen(SIDE)
    for _ in range(3 * WARM):
        begun_s = time.monotonic()
        backend.predict(observation)
        alone.took_s.append(time.monotonic() - begun_s)
    backend.close()
    return statistics.median(alone.took_s[WARM:])


def together(robots: Sequence[Robot]) -> list[Robot]:
    """Answers to each robot over all its connections."""
    found: dict[int, Robot] = {}
    for robot in robots:
        one = found.setdefault(robot.name, Robot(robot.name))
        one.took_s += robot.took_s
        one.refused += robot.refused
        one.late_rows += robot.late_rows
        one.rows += robot.rows
    return [found[name] for name in sorted(found)]


def table(robots: Sequence[Robot]) -> str:
    """A line for each robot."""
    total = sum(len(robot.took_s) for robot in robots)
    lines = ["robot  answers  refused  share of 1/n  p50 ms  p99 ms  late rows"]
    for robot in robots:
        took_ms = np.array(robot.took_s or [float("nan")]) * 1e3
        share = len(robot.took_s) / total * len(robots)
        lines.append(
            f"{'greedy' if robot.name == 0 else robot.name:>6} {len(robot.took_s):8d} "
            f"{robot.refused:8d} {share:13.2f} {np.median(took_ms):7.0f} "
            f"{np.percentile(took_ms, 99):7.0f} {robot.late_rows / max(robot.rows, 1):10.1%}"
        )
    return "\n".join(lines)


def main() -> int:
    """Run it; exit status 0 unless something fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--replicas", type=int, default=1)
    parser.add_argument("--demand", type=float, default=0.4)
    parser.add_argument(
        "--connections", type=int, default=0, help="of the greedy one, told apart by address"
    )
    parser.add_argument("--drive", nargs=5, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.drive:
        drive_some(given.drive)
        return 0
    if not 0 <= given.connections <= MOST_CONNECTIONS:
        parser.error(f"--connections {given.connections}: expected 0 to {MOST_CONNECTIONS}")
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        install(folder)
        path = os.pathsep.join(filter(None, (str(folder / "site"), os.environ.get("PYTHONPATH"))))
        pair(folder)
        os.environ["XDG_STATE_HOME"] = str(folder / "robot")
        address = serve(stack, folder, path, given.replicas, by_token=bool(given.connections))
        if given.connections:
            os.environ[TOKEN] = (folder / "token").read_text().strip()
        alone_s = forward_s(address)
        period_s = alone_s * given.robots / given.demand / given.replicas
        begin_s = time.monotonic() + 15.0
        names = [0] * max(given.connections - 1, 0) + list(range(given.robots))
        size = max(IN_A_PROCESS, len(names) // IN_A_PROCESS)
        groups = [names[i : i + size] for i in range(0, len(names), size)]
        processes = [
            started(
                stack,
                [
                    *(sys.executable, __file__, "--drive", ",".join(map(str, group)), address),
                    *(repr(value) for value in (period_s, begin_s, given.seconds)),
                ],
                stdout=subprocess.PIPE,
            )
            for group in groups
        ]
        robots = []
        for process in processes:
            said, _ = process.communicate(timeout=given.seconds + 120.0)
            robots += [Robot(**one) for one in json.loads(said)]
        robots = together(robots)
        print(
            f"{given.robots} robots, {given.replicas} replicas, {given.seconds:g} s, load "
            f"{load:.1f}; alone {alone_s * 1e3:.1f} ms, period {period_s * 1e3:.0f} ms"
        )
        print(table(robots))
        answers = [len(robot.took_s) for robot in robots]
        middle = statistics.median(answers[1:])
        most, least = answers[0] / middle, min(answers[1:]) / middle
        print(f"greedy {most:.2f}, least {least:.2f} times the median of the others")
        if least < LEAST_SHARE or (given.demand >= CROWDED and most > MOST_SHARE):
            print(f"{MISSED}expected at most {MOST_SHARE:g} and at least {LEAST_SHARE:g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
