"""Warm switches on a robot with two arms: another policy, in another control space, and another
control take over while both arms move, without a hold.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import anyio
import pytest
from pair_agent import PATIENCE_S, STILL_RAD, configured, moved_rad

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import DemoAgent, module_status


async def _control(agent: DemoAgent) -> dict[str, Any]:
    return module_status(await agent.status(), "control")


async def _check_moving(agent: DemoAgent) -> None:
    """Check that each arm moves, by actions that control follows."""
    until_s = time.monotonic() + PATIENCE_S
    while min((await moved_rad(agent, 0.3)).values()) < 5 * STILL_RAD:
        assert time.monotonic() < until_s, "the arms do not move"


async def _scenario(config: Path, log: Path) -> None:
    async with spawned_server(["--config", str(config)], log) as client:
        agent = DemoAgent(client)
        for tool in ("start_robot", "start_perception", "start_control"):
            await agent.call(tool)
        await agent.call("start_inference", {"instruction": "wave"})
        await _check_moving(agent)
        for backend in ("placing", "waving"):
            before = await _control(agent)
            done = await agent.call("switch_inference", {"backend": backend})
            assert done["mode"] == "warm", done
            await _check_moving(agent)
            after = await _control(agent)
            assert after["dropped_by"].get("holds", 0) == before["dropped_by"].get("holds", 0)
            space = module_status(await agent.status(), "inference")["metrics"]["space"]
            kind = "joint_position" if backend == "placing" else "joint_velocity"
            assert space.startswith(kind)
            assert "right/right_fr3_joint7" in space
        done = await agent.call("switch_control", {})
        assert done["mode"] == "warm", done
        await _check_moving(agent)
        assert (await _control(agent))["dropped_by"].get("holds", 0) == 0
        await agent.call("stop_all")


@pytest.mark.ros
@pytest.mark.timing
@pytest.mark.timeout(180)
def test_policies_and_control_of_two_arms_are_replaced_warm(
    tmp_path: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with configured(tmp_path) as (config, site):
        for name in ("ROS_DOMAIN_ID", "XDG_STATE_HOME"):
            monkeypatch.setenv(name, environment[name])
        monkeypatch.setenv("PYTHONPATH", str(site))
        anyio.run(_scenario, config, tmp_path / "server.log")
