"""Over MCP: if a policy for two arms starts to answer wrongly, one clear error is reported, both
arms come to rest, and the next instruction moves them again. Errors of wrong calls name the arms.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest
from pair_agent import PATIENCE_S, STILL_RAD, configured, moved_rad, positions

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import DemoAgent, module_status
from roboneuron import NotReadyError

FAULTS = {
    "fourteen values for one arm": "A chunk has shape (2, 14), expected (H >= 1, 8)",
    "the wrong arm": "middle/right_fr3_joint1",
    "no number": "non-finite value at right/right_fr3_joint2",
    "another space": "The backend answered in joint_position",
}


async def _until(
    agent: DemoAgent, told: Callable[[dict[str, float], str], bool], what: str
) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while True:
        moved = await moved_rad(agent, 0.2)
        error = str(module_status(await agent.status(), "inference").get("error") or "")
        if told(moved, error):
            return
        assert time.monotonic() < until_s, f"{what}: {moved}, {error!r}"


async def _check_fault(agent: DemoAgent, fault: str, told: str) -> None:
    await agent.call("set_instruction", {"instruction": "wave"})
    await _until(agent, lambda moved, error: min(moved.values()) > 5 * STILL_RAD, "they wave")
    try:
        await agent.call("set_instruction", {"instruction": fault})
    except NotReadyError as error:  # it is told at once if the policy answers soon
        assert told in str(error)  # noqa: PT017
    await _until(
        agent,
        lambda moved, error: told in error and max(moved.values()) < STILL_RAD,
        f"{fault!r} is told, and both rest",
    )
    assert max((await moved_rad(agent, 1.0)).values()) < STILL_RAD


async def _scenario(config: Path, log: Path) -> None:
    async with spawned_server(["--config", str(config)], log) as client:
        agent = DemoAgent(client)
        for tool in ("start_robot", "start_control"):
            await agent.call(tool)
        for arguments, told in (
            ({"dx_m": 0.05}, "'arm' is missing"),
            ({"arm": "middle", "dx_m": 0.05}, "'middle'. Choose one of: left, right"),
            ({"arm": "left"}, "asks for no move"),
        ):
            with pytest.raises(NotReadyError, match=told):
                await agent.call("move_ee", arguments)
        for arm in ("left", "right"):
            before = await positions(agent)
            moved: Any = await agent.call("move_ee", {"arm": arm, "dz_m": 0.03, "dy_m": 0.02})
            after = await positions(agent)
            assert moved["arm"] == arm
            assert moved["error_m"] < 0.004
            other = "right" if arm == "left" else "left"
            rest = max(abs(after[n] - before[n]) for n in after if n.startswith(other))
            assert rest < STILL_RAD, "the other arm stays where it is"
        shut: Any = await agent.call("move_ee", {"arm": "right", "gripper_open": 0.2})
        assert shut["holding"] is False
        metrics = module_status(await agent.status(), "robot")["metrics"]
        assert float(metrics["right/gripper_commanded"]) == pytest.approx(0.2, abs=0.01)
        assert float(metrics["left/gripper_commanded"]) == pytest.approx(1.0, abs=0.01)
        for tool in ("start_perception", "start_inference"):
            await agent.call(tool)
        for fault, told in FAULTS.items():
            await _check_fault(agent, fault, told)
        await agent.call("stop_all")


@pytest.mark.exhaustive
@pytest.mark.ros
@pytest.mark.timeout(180)
def test_what_a_policy_or_a_caller_says_wrongly_of_two_arms(
    tmp_path: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with configured(tmp_path) as (config, site):
        for name in ("ROS_DOMAIN_ID", "XDG_STATE_HOME"):
            monkeypatch.setenv(name, environment[name])
        monkeypatch.setenv("PYTHONPATH", str(site))
        anyio.run(_scenario, config, tmp_path / "server.log")
