"""Control holds some time after its last action; a joint motion that starts before that is not
ended by the hold.
"""

from __future__ import annotations

import sys
from pathlib import Path

import anyio
import pytest
from mcp import Client, StdioServerParameters

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
CONFIG = """
[robot]
name = "fr3"
[control]
controller = "urdf"
[supervisor]
start_timeout_s = 120.0
state_directory = "{state}"
"""


@pytest.mark.parametrize("times", [1, pytest.param(3, marks=pytest.mark.exhaustive)])
def test_home_is_reached_right_after_the_hand_was_moved(tmp_path: Path, times: int) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"), encoding="utf-8")
    command = [
        "-m",
        "roboneuron.cli.main",
        "serve",
        "--config",
        str(config),
        "--log-level",
        "error",
    ]

    async def talk() -> None:
        async with Client(StdioServerParameters(command=sys.executable, args=command)) as client:
            for tool in ("start_robot", "start_control"):
                answer = await client.call_tool(tool, {})
                assert not answer.is_error, answer.content
            for _ in range(times):
                moved = await client.call_tool("move_ee", {"dz_m": -0.05})
                assert not moved.is_error, moved.content
                there = await client.call_tool("move_to", {"name": "home"})
                assert not there.is_error, there.content
                assert there.structured_content["error"] < 0.01

    anyio.run(talk)
