"""`roboneuron serve` with all its modules on the robot's machine, and a ROS process of the project
on another one.

The member receives joint states and images. Its actions pass the limits and the emergency stop of
the robot's control module; it cannot control modules. A foreign node on the network receives
nothing and moves nothing.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from link_machines import Machine, Talker, impossible, machines
from link_pairs import pair
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_testing.agent import Agent
from rn_testing.waiting import wait_until
from roboneuron.config import default_text

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
WATCHER = Path(__file__).with_name("link_watcher.py")
STILL_RAD = 0.003
"""Noise of the simulated joints between two measurements of a resting arm."""
MOVED_RAD = 0.03


class Watcher:
    """A process on another machine that observes the robot."""

    def __init__(self, machine: Machine, name: str, *arguments: str, link: bool = True) -> None:
        variables = {} if link else {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
        self._folder = machine.state
        self._name = name
        self.process: Talker = machine.talk(
            name, *arguments, link=link, script=WATCHER, **variables
        )

    def count(self, what: str) -> int:
        return int(self.process.report().get(what, 0))

    def answer(self, what: str) -> Any:
        return self.process.report().get(what)

    def positions(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        return np.array(self.process.report()["positions"])

    def moved_rad(self, for_s: float = 2.0) -> float:
        """Measured motion of the joint that moves most within this time [rad]."""
        before, begun_s = self.positions(), time.monotonic()
        wait_until(lambda: time.monotonic() > begun_s + for_s, 10.0, "time to move")
        return float(np.abs(self.positions() - before).max())

    def tell(self, what: str, *, begin: bool = True) -> None:
        """Let it start or stop an activity: "act" or "ask"."""
        path = self._folder / f"{self._name}.{what}"
        if begin:
            path.touch()
        else:
            path.unlink()

    def wait_for(self, what: str, more: int) -> None:
        goal = self.count(what) + more
        wait_until(
            lambda: self.count(what) >= goal,
            30.0,
            f"{what}: {self.process.report()}, {self.process.log.read_text()[-2000:]}",
        )


async def serve_and_watch(robot: Machine, gpu: Machine, stranger: Machine) -> None:
    """Run the scenario."""
    config = robot.state / "roboneuron.toml"
    config.write_text(f"{default_text()}\n[link]\nrequired = true\n")
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(config), "--log-level", "error"]
    inside = robot.inside(sys.executable, *words)
    server = StdioServerParameters(
        command=inside[0],
        args=inside[1:],
        env={**os.environ, "XDG_STATE_HOME": str(robot.state)},
    )
    async with Client(stdio_client(server)) as client:
        do = Agent(client).do

        assert "start_inference" in {tool.name for tool in (await client.list_tools()).tools}
        for tool in ("start_robot", "start_perception", "start_control"):
            await do(tool)
        far = Watcher(gpu, "far")
        await anyio.to_thread.run_sync(check_seen, far)
        alien = Watcher(stranger, "alien", str(far.answer("namespace")), link=False)
        alien.tell("act")
        wait_until(lambda: alien.process.report(), 30.0, "the stranger")
        assert far.moved_rad(3.0) < STILL_RAD, "the stranger acts"
        await do("start_inference", instruction="pick up the red cube")
        wait_until(lambda: far.moved_rad() > MOVED_RAD, 30.0, "the arm moves by its own policy")
        await do("stop_inference")
        far.tell("ask")
        wait_until(lambda: far.answer("answer") is not None, 30.0, "an answer")
        assert far.answer("answer") is False, "a module obeys its server alone"
        wait_until(lambda: far.moved_rad() < STILL_RAD, 20.0, "the arm stands")
        far.tell("act")
        wait_until(lambda: far.moved_rad() > MOVED_RAD, 20.0, "the arm moves by its actions")
        await do("emergency_stop")
        wait_until(lambda: far.moved_rad() < STILL_RAD, 20.0, "the arm stands")
        assert far.moved_rad(3.0) < STILL_RAD, "the member still acts"
        far.wait_for("images", 5)
        await do("stop_all")
        assert (alien.count("joint_states"), alien.count("images")) == (0, 0)
        assert not [one for one in alien.answer("nodes") if "alien" not in one]


def check_seen(far: Watcher) -> None:
    """Check that the member receives modules, joint states and images."""
    far.wait_for("joint_states", 20)
    far.wait_for("images", 5)
    modules = ("control", "perception", "robot")
    wait_until(lambda: all(one in str(far.answer("nodes")) for one in modules), 20.0, "all nodes")


def test_a_served_robot_is_seen_and_stays_behind_its_gate(tmp_path: Path) -> None:
    with machines(tmp_path, "robot", "gpu", "stranger") as made:
        pair(made["robot"], made["gpu"])
        anyio.run(serve_and_watch, made["robot"], made["gpu"], made["stranger"])
