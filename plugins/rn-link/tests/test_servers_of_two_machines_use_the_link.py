"""`roboneuron serve` on the robot's machine and on another one, with ROS over the link.

The other machine receives joint states and images, and its inference module moves the arm, within
the limits and the emergency stop of the robot's control module; without the link the arm holds. A
foreign node on the network receives nothing and moves nothing.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import anyio
import numpy as np
import pytest
from link_machines import WATCHER, Machine, Talker, impossible, machines
from link_pairs import pair
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_link.state import PeerConnection, read_connections
from rn_testing.agent import Agent
from rn_testing.waiting import wait_until
from roboneuron.config import default_text

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
STILL_RAD, MOVED_RAD = 0.003, 0.03
"""Noise of the simulated joints between two measurements of a resting arm, and a motion."""
HOLDS_S = 3.0
"""Time after a cut cable: the longest age of an action, with a margin for a busy machine."""


@asynccontextmanager
async def agent_of(machine: Machine) -> AsyncIterator[Agent]:
    """A server of that machine, and its client."""
    path = machine.state / "roboneuron.toml"
    path.write_text(default_text())
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(path), "--log-level", "error"]
    command, *arguments = machine.inside(sys.executable, *words)
    server = StdioServerParameters(
        command=command, args=arguments, env={**os.environ, "XDG_STATE_HOME": str(machine.state)}
    )
    async with Client(stdio_client(server)) as client:
        yield Agent(client)


def wait_for_link(machine: Machine, name: str, is_open: bool) -> PeerConnection:
    """Wait until the machine reports another one as connected, or not."""

    def found() -> PeerConnection:
        return (read_connections(machine.link) or {}).get(name, PeerConnection())

    wait_until(lambda: found().is_open is is_open, 40.0, f"{name}: {is_open}")
    return found()


def moved_rad(watcher: Talker, for_s: float = 2.0) -> float:
    """Measured motion of the joint that moves most within this time [rad]."""
    before, begun_s = np.array(watcher.report()["positions"]), time.monotonic()
    wait_until(lambda: time.monotonic() > begun_s + for_s, 10.0, "time to move")
    return float(np.abs(np.array(watcher.report()["positions"]) - before).max())


def rests(watcher: Talker) -> bool:
    return moved_rad(watcher) < STILL_RAD


def moves(watcher: Talker) -> bool:
    return moved_rad(watcher) > MOVED_RAD


async def use_both(robot: Machine, gpu: Machine, other: Machine) -> None:
    """Run the scenario."""
    async with agent_of(robot) as here, agent_of(gpu) as there:
        for tool in ("start_robot", "start_perception", "start_control"):
            await here.do(tool)
        near, far = (one.talk("watcher", script=WATCHER) for one in (robot, gpu))
        wait_until(lambda: near.report().get("positions"), 30.0, "the arm is measured")
        for what in ("joint_states", "images"):
            wait_until(lambda what=what: far.report().get(what, 0) > 20, 30.0, what)
        modules = ("control", "perception", "robot")
        wait_until(lambda: all(one in str(far.report()["nodes"]) for one in modules), 20.0, "nodes")
        alien = other.talk(
            "alien",
            str(far.report()["namespace"]),
            link=False,
            script=WATCHER,
            ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET",
        )
        (other.state / "alien.act").touch()
        wait_until(alien.report, 30.0, "the foreign node")
        assert rests(near), "the foreign node acts"
        await there.do("start_inference", instruction="pick up the red cube")
        wait_until(lambda: moves(near), 60.0, "the arm moves by the far policy")
        gpu.cut()
        cut_s = time.monotonic()
        wait_until(lambda: time.monotonic() > cut_s + HOLDS_S, 10.0, "time to hold")
        assert rests(near), "the arm holds without the other machine"
        for machine, name in ((robot, "gpu"), (gpu, "robot")):
            assert wait_for_link(machine, name, False).hint
        gpu.plug()
        for machine, name in ((robot, "gpu"), (gpu, "robot")):
            wait_for_link(machine, name, True)
        await there.do("stop_inference")
        (gpu.state / "watcher.act").touch()
        wait_until(lambda: moves(near), 20.0, "the arm moves by actions of the other machine")
        await here.do("emergency_stop")
        wait_until(lambda: rests(near), 20.0, "the arm is stopped")
        assert rests(near), "the other machine still acts"
        await here.do("stop_all")
        found = alien.report()
        assert (found["joint_states"], found["images"]) == (0, 0)
        assert not [one for one in found["nodes"] if "alien" not in one]


def test_servers_of_two_machines_share_a_robot(tmp_path: Path) -> None:
    with machines(tmp_path, "robot", "gpu", "other") as made:
        pair(made["robot"], made["gpu"])
        anyio.run(use_both, made["robot"], made["gpu"], made["other"])
