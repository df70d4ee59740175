"""A fleet of fakes in this process, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, types

from rn_standard.fleet.fleet import Fleet
from rn_standard.fleet.plugin import FEATURE
from rn_standard.http.plugin import FEATURE as HTTP
from rn_standard.ops.plugin import CLIENTS
from rn_testing.fakes import fake_registry
from roboneuron.config import parse_config
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.tools.arm.plugin import FEATURE as ARM
from roboneuron.tools.arm.plugin import STOP_MOTION
from roboneuron.tools.ros.plugin import FEATURE as ROS_TOOLS

TWO = """
[robots.left]
robot = "gantry"
[robots.left.inference]
backend = "instant"
[robots.right-arm]
robot = "gantry"
"""
Call = Callable[..., types.CallToolResult]


@pytest.fixture
def make_fleet(tmp_path: Path) -> Iterator[Callable[[str], Fleet]]:
    """Return a function that makes a fleet from a configuration; nothing may be spawned."""
    fleets: list[Fleet] = []
    registry = fake_registry(FEATURE, CLIENTS, DIRECT_PATH, HTTP, ARM, STOP_MOTION, ROS_TOOLS)

    def make(text: str = TWO) -> Fleet:
        fleets.append(
            Fleet(
                parse_config(text, registry=registry),
                tmp_path,
                plugins=lambda: registry,
                command=lambda python: pytest.fail("nothing may be spawned"),
            )
        )
        return fleets[-1]

    yield make
    for fleet in fleets:
        fleet.close()


@pytest.fixture
def fleet(make_fleet: Callable[..., Fleet]) -> Fleet:
    """The robots left and right-arm."""
    return make_fleet()


@pytest.fixture
def call() -> Call:
    """Return a function that makes one call over MCP."""

    def call(
        fleet: Fleet, tool: str, arguments: Mapping[str, Any] | None = None
    ) -> types.CallToolResult:
        async def ask() -> types.CallToolResult:
            async with Client(fleet.server) as client:
                return await client.call_tool(tool, dict(arguments or {}))

        return anyio.run(ask)

    return call
