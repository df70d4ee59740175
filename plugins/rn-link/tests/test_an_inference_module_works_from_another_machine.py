"""An inference module alone on another machine, connected by ROS over the link: `roboneuron serve`
on that machine starts it; robot, cameras and control run on the robot's machine.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from link_machines import Machine, Talker, impossible, machines
from link_pairs import pair
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_testing.waiting import wait_until
from roboneuron.config import default_text

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
WATCHER = Path(__file__).with_name("link_watcher.py")
STILL_RAD, MOVED_RAD = 0.003, 0.03
HOLDS_S = 3.0
"""Time after a cut cable: the longest age of an action, with a margin for a busy machine."""


@asynccontextmanager
async def agent_of(machine: Machine) -> AsyncIterator[Client]:
    """A server of that machine with the default configuration, and its client."""
    path = machine.state / "roboneuron.toml"
    path.write_text(f"{default_text()}\n[link]\nrequired = true\n")
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(path), "--log-level", "error"]
    command, *arguments = machine.inside(sys.executable, *words)
    server = StdioServerParameters(
        command=command,
        args=arguments,
        env={**os.environ, "XDG_STATE_HOME": str(machine.state)},
    )
    async with Client(stdio_client(server)) as client:
        yield client


async def do(client: Client, tool: str, **arguments: Any) -> None:
    """Make a call that must succeed."""
    answer = await client.call_tool(tool, arguments)
    assert not answer.is_error, answer.content


def moved_rad(watcher: Talker, for_s: float = 2.0) -> float:
    """Motion of the joint that moves most within this time [rad]."""
    before, begun_s = np.array(watcher.report()["positions"]), time.monotonic()
    wait_until(lambda: time.monotonic() > begun_s + for_s, 10.0, "time to move")
    return float(np.abs(np.array(watcher.report()["positions"]) - before).max())


async def infer_there(robot: Machine, gpu: Machine) -> None:
    """Run the scenario."""
    watcher = robot.talk("watcher", script=WATCHER)
    async with agent_of(robot) as here, agent_of(gpu) as there:
        for tool in ("start_robot", "start_perception", "start_control"):
            await do(here, tool)
        wait_until(lambda: watcher.report().get("positions"), 30.0, "the arm is measured")
        assert moved_rad(watcher) < STILL_RAD
        await do(there, "start_inference", instruction="pick up the red cube")
        wait_until(lambda: moved_rad(watcher) > MOVED_RAD, 60.0, "the arm moves by the far policy")
        gpu.cut()
        cut_s = time.monotonic()
        wait_until(lambda: time.monotonic() > cut_s + HOLDS_S, 10.0, "time to hold")
        assert moved_rad(watcher) < STILL_RAD, "the arm holds without the other machine"
        gpu.plug()
        await do(here, "emergency_stop")
        wait_until(lambda: moved_rad(watcher) < STILL_RAD, 20.0, "the arm is stopped")
        assert moved_rad(watcher, 3.0) < STILL_RAD, "the far module moves a stopped arm"
        await do(there, "stop_inference")
        await do(here, "stop_all")


def test_an_inference_module_moves_the_arm_of_another_machine(tmp_path: Path) -> None:
    with machines(tmp_path, "robot", "gpu") as made:
        pair(made["robot"], made["gpu"])
        anyio.run(infer_there, made["robot"], made["gpu"])
