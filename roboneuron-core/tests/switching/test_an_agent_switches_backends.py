"""The tools around a real loop: a switch answers with a summary, and keeps the instruction."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client
from plugin_site import installed
from switch_loop import CONFIG

from rn_testing.agent import Agent
from roboneuron.config import parse_config
from roboneuron.server.app import Application

pytestmark = [pytest.mark.ros, pytest.mark.timeout(150)]


def test_an_agent_switches_and_goes_back(tmp_path: Path) -> None:
    async def scenario(application: Application) -> None:
        async with Client(application.server) as client:
            do = Agent(client).do

            async def inference() -> dict[str, Any]:
                return next(
                    m for m in (await do("get_status"))["modules"] if m["module"] == "inference"
                )

            for kind in ("robot", "perception", "control"):
                await do(f"start_{kind}")
            started = await do("start_inference", instruction="move on")
            assert started.keys() == {
                "module",
                "phase",
                "health",
                "pid",
                "started_with",
                "took_s",
                "acts_on",
            }
            refused = await client.call_tool(
                "switch_inference", {"backend": "first", "acceleration": "none"}
            )
            assert refused.is_error
            assert (await inference())["pid"] == started["pid"]
            switched = await do("switch_inference", backend="second")
            assert switched["module"] == "inference"
            assert switched["phase"] == "running"
            assert switched["started_with"]["backend"] == "second"
            assert switched["replaced"]["backend"] == "first"
            assert switched["pid"] != started["pid"]
            assert switched["gap_s"] > 0
            assert (await inference())["instruction"] == "move on"
            back = await do("switch_inference", rollback=True)
            assert back["started_with"]["backend"] == "first"
            await do("stop_all")

    with installed(tmp_path, "rn-switch", ("switch_plugin",)):
        config = parse_config(CONFIG.format(rate_hz=10.0, camera_options=""))
        application = Application(config, directory=tmp_path / "state")
        try:
            anyio.run(scenario, application)
        finally:
            application.close()
