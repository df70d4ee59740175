"""A robot and a policy server on two machines (network namespaces): cut cables, peers that
disappear silently, slow links. Needs root.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from link_machines import Machine, impossible, machines
from policy_servers import FarServer, pair

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
ROBOT = Path(__file__).with_name("policy_robot.py")
TIMEOUT_S = 0.3
CUTS = int(os.environ.get("ROBONEURON_CUTS", "5"))
MARGIN_S = 0.25
"""Margin of a deadline on a busy machine."""


class Robot:
    """A robot that sends requests continuously, on its own machine."""

    def __init__(self, machine: Machine, site: Path, side: int = 64, **options: Any) -> None:
        self.path = machine.state / "robot.jsonl"
        given = {"address": "gpu:7420", "timeout_s": TIMEOUT_S, "coding": "raw", **options}
        words = [sys.executable, str(ROBOT), str(self.path), json.dumps(given), str(side)]
        path = os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH"))))
        self._log = (machine.state / "robot.log").open("wb")
        self.process = subprocess.Popen(
            machine.inside(*words),
            env={**os.environ, "XDG_STATE_HOME": str(machine.state), "PYTHONPATH": path},
            stdout=self._log,
            stderr=self._log,
        )

    def lines(self, since_s: float = 0.0) -> list[dict[str, Any]]:
        """Answers to requests sent after that time (monotonic [s])."""
        if not self.path.exists():
            return []
        whole = self.path.read_text().rpartition("\n")[0].splitlines()
        return [line for line in map(json.loads, whole) if line["at_s"] >= since_s]

    def wait_for_answers(self, since_s: float, count: int = 3, timeout_s: float = 20.0) -> float:
        """Wait for answers again; returns the time that it took [s]."""
        return wait_until(
            lambda: sum(line["ok"] for line in self.lines(since_s)) >= count,
            timeout_s,
            f"it is answered: {self.lines(since_s)[-3:]}",
        )

    def end(self) -> None:
        """Kill it."""
        self.process.kill()
        self.process.wait(10.0)
        self._log.close()


@contextmanager
def cell(tmp_path: Path, **options: Any) -> Iterator[tuple[Machine, Machine, Robot, FarServer]]:
    """Two paired machines, with a server on one and a robot on the other."""
    with machines(tmp_path, "robot", "gpu") as both:
        here, there = both["robot"], both["gpu"]
        pair(here.state, there.state, address=there.address)
        server = FarServer(tmp_path, {"only": {}}, {"host": "0.0.0.0", "port": 7420}, there.state)
        server.machine = there
        robot = None
        try:
            server.start()
            robot = Robot(here, tmp_path / "site", **options)
            robot.wait_for_answers(0.0, timeout_s=60.0)
            yield here, there, robot, server
        finally:
            if robot is not None:
                robot.end()
            server.end()


def check_nothing_was_late(robot: Robot) -> None:
    """Check that no answer belongs to another request, and that no request waited beyond its
    deadline.
    """
    lines = robot.lines()
    assert [line for line in lines if line["ok"] and line["far"] > 0.0] == []
    assert max(line["took_s"] for line in lines[1:]) < TIMEOUT_S + MARGIN_S
    assert {line["error"] for line in lines if not line["ok"]} <= {"not_ready"}


def test_cables_that_are_cut_cost_no_more_than_a_deadline_and_the_robot_comes_back(
    tmp_path: Path,
) -> None:
    drawn, back_s = random.Random(0), []
    with cell(tmp_path) as (here, there, robot, _):
        for number in range(CUTS):
            end = (here, there)[number % 2]
            time.sleep(drawn.uniform(0.0, 0.2))
            end.cut()
            cut_s = time.monotonic()
            time.sleep(drawn.uniform(0.2, 1.5))
            assert not any(line["ok"] for line in robot.lines(cut_s))
            end.plug()
            back_s.append(robot.wait_for_answers(time.monotonic()))
        check_nothing_was_late(robot)
    print(f"{CUTS} cuts, answered again after {max(back_s):.1f} s at most")


def test_a_peer_that_is_gone_without_a_word_is_noticed_and_found_again(tmp_path: Path) -> None:
    with cell(tmp_path) as (here, there, robot, server):
        here.lose(there)
        there.lose(here)
        lost_s = time.monotonic()
        wait_until(
            lambda: any("no connection" in line.get("message", "") for line in robot.lines(lost_s)),
            20.0,
            "the robot has given the connection up",
        )
        wait_until(lambda: server.status()["robots"] == 0, 30.0, "and so has the server")
        here.find(there)
        there.find(here)
        robot.wait_for_answers(time.monotonic())
        check_nothing_was_late(robot)


def test_a_server_that_freezes_or_dies_costs_no_more_than_a_deadline(tmp_path: Path) -> None:
    with cell(tmp_path) as (_, _, robot, server):
        for pid in (server.status()["pid"], server.status()["models"]["only"]["pid"]):
            os.kill(pid, signal.SIGSTOP)
            time.sleep(2.0)
            os.kill(pid, signal.SIGCONT)
            robot.wait_for_answers(time.monotonic())
        os.kill(server.status()["models"]["only"]["pid"], signal.SIGKILL)
        robot.wait_for_answers(time.monotonic() + 0.1, timeout_s=60.0)
        server.kill()
        server.start()
        robot.wait_for_answers(time.monotonic(), timeout_s=60.0)
        check_nothing_was_late(robot)


def test_images_are_coded_when_the_link_becomes_slow(tmp_path: Path) -> None:
    wide = {"coding": "auto", "timeout_s": 5.0, "parity_m": 1.0, "parity_rad": 1.0}
    with cell(tmp_path, side=224, **wide) as (here, _, robot, _):
        assert robot.lines()[-1]["coding"] == 0.0, "raw as long as the link carries it"
        limit = ["rate", "8mbit", "burst", "16kb", "latency", "2s"]
        here.run("tc", "qdisc", "add", "dev", "cable", "root", "tbf", *limit)
        wait_until(lambda: robot.lines()[-1].get("coding") == 2.0, 60.0, "as JPEG")
        here.run("tc", "qdisc", "del", "dev", "cable", "root")
        wait_until(lambda: robot.lines()[-1].get("coding") == 0.0, 60.0, "raw again")
        assert all(line["ok"] for line in robot.lines()), "no answer was missed meanwhile"
