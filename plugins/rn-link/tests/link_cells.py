"""Servers and watchers on the machines of `link_machines`."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import anyio
import numpy as np
from link_machines import Machine, Talker
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_link.state import PeerConnection, read_connections
from rn_testing.agent import Agent
from rn_testing.waiting import wait_until
from roboneuron.config import default_text

WATCHER = Path(__file__).with_name("link_watcher.py")
STILL_RAD, MOVED_RAD = 0.003, 0.03
"""Noise of the simulated joints between two measurements of a resting arm, and a motion."""
BOUND_S = 40.0


@asynccontextmanager
async def agent_of(machine: Machine, config: str = "") -> AsyncIterator[Agent]:
    """A server of that machine that requires the link, and its client.

    Args:
        config: its configuration; empty for the default one.
    """
    path = machine.state / "roboneuron.toml"
    path.write_text(f"{config or default_text()}\n[link]\nrequired = true\n")
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(path), "--log-level", "error"]
    command, *arguments = machine.inside(sys.executable, *words)
    server = StdioServerParameters(
        command=command, args=arguments, env={**os.environ, "XDG_STATE_HOME": str(machine.state)}
    )
    async with Client(stdio_client(server)) as client:
        yield Agent(client)


async def until_connected(machine: Machine, name: str, is_open: bool) -> PeerConnection:
    """Wait until the machine reports another one as connected, or not."""
    with anyio.fail_after(BOUND_S):
        while True:
            found = (read_connections(machine.link) or {}).get(name)
            if found is not None and found.is_open is is_open:
                return found
            await anyio.sleep(0.2)


def moved_rad(watcher: Talker, for_s: float = 2.0) -> float:
    """Measured motion of the joint that moves most within this time [rad]."""
    before, begun_s = np.array(watcher.report()["positions"]), time.monotonic()
    wait_until(lambda: time.monotonic() > begun_s + for_s, 10.0, "time to move")
    return float(np.abs(np.array(watcher.report()["positions"]) - before).max())


def wait_for_count(watcher: Talker, what: str, more: int) -> None:
    """Wait until the watcher has received more of `what`."""
    goal = watcher.report().get(what, 0) + more
    wait_until(
        lambda: watcher.report().get(what, 0) >= goal,
        30.0,
        f"{what}: {watcher.report()}, {watcher.log.read_text()[-2000:]}",
    )


def tell(machine: Machine, watcher: Talker, what: str) -> None:
    """Let a watcher of that machine start an activity: "act" or "ask"."""
    (machine.state / f"{watcher.name}.{what}").touch()
