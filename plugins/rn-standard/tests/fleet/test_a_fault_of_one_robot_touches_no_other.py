"""One server process, two robots: one is killed, stopped and started again; the other works on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_testing.domain import free_ros_domain
from rn_testing.fakes.site import PluginSite

pytestmark = pytest.mark.ros
LONG_S = 300
CONFIG = """
features = ["fleet"]
[supervisor]
start_timeout_s = 200.0
state_directory = "{state}"
[robots.left]
robot = "gantry"
[robots.right]
robot = "gantry"
"""
PLUGIN = """
@hookimpl
def roboneuron_robots():
    from rn_testing.fakes.robot import FAKE_ROBOT

    return [FAKE_ROBOT]
"""


async def until(look: Callable[[], Any]) -> Any:
    """The first true answer."""
    with anyio.fail_after(LONG_S):
        while not (seen := await look()):
            await anyio.sleep(0.1)
    return seen


def test_a_killed_robot_and_a_stopped_robot_leave_the_other_alone(tmp_path: Path) -> None:
    site, state, config = tmp_path / "site", tmp_path / "state", tmp_path / "fleet.toml"
    PluginSite(path=site).install("rn-two-robots", PLUGIN)
    config.write_text(CONFIG.format(state=state))
    environment = {**os.environ, "PYTHONPATH": str(site), "ROS_DOMAIN_ID": str(free_ros_domain())}
    command = [sys.executable, "-m", "roboneuron.cli.main"]
    server = StdioServerParameters(
        command=command[0], args=[*command[1:], "serve", "--config", str(config)], env=environment
    )

    async def run() -> None:
        async with Client(stdio_client(server)) as client:

            async def call(tool: str, **arguments: Any) -> dict[str, Any]:
                result = await client.call_tool(tool, arguments, read_timeout_seconds=LONG_S)
                assert not result.is_error, result.content
                return dict(result.structured_content or {})

            async def robot(name: str) -> dict[str, Any]:
                status = await call("get_status", robot=name)
                module = next(module for module in status["modules"] if module["module"] == "robot")
                return {**module, "emergency_stop": status["emergency_stop"]}

            async with anyio.create_task_group() as starting:
                for name in ("left", "right"):
                    starting.start_soon(lambda name=name: call("start_robot", robot=name))
            before = await robot("right")
            killed = await robot("left")
            assert killed["pid"] != before["pid"]

            os.kill(killed["pid"], signal.SIGKILL)

            async def is_gone() -> bool:
                return (await robot("left"))["health"] == "exited"

            await until(is_gone)
            assert (await robot("right"))["pid"] == before["pid"]

            def records() -> list[str]:
                return [
                    path.name
                    for path in (state / "robots" / "left" / "incidents").glob("*exited*.json")
                ]

            async def is_recorded() -> bool:
                return bool(records())

            await until(is_recorded)  # it is written after the status says so
            assert len(records()) == 1
            assert not list((state / "robots" / "right").glob("incidents/*exited*"))
            await call("start_robot", robot="left")

            await call("emergency_stop", robot="left")
            assert (await robot("left"))["emergency_stop"] is True
            assert (await robot("right"))["emergency_stop"] is False
            stopped = await call("emergency_stop", reason="all")
            assert sorted(stopped["confirmed_by"]) == ["left/robot", "right/robot"]
            assert (await robot("right"))["emergency_stop"] is True
            told = await anyio.to_thread.run_sync(
                lambda: subprocess.run(
                    [*command, "estop", "--status", "--config", str(config)],
                    capture_output=True, text=True, env=environment, timeout=LONG_S, check=False,
                )
            )  # fmt: skip
            assert told.returncode == 1
            assert [line.split(" by ")[0] for line in told.stdout.splitlines()] == [
                f"The emergency stop is not latched ({state / 'emergency_stop.latched'}).",
                "The emergency stop is latched",
                "The emergency stop is latched",
            ]
            assert (await robot("right"))["pid"] == before["pid"]

    anyio.run(run)
