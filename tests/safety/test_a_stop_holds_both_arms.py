"""An emergency stop while both arms of fr3-pair move: both hold, and nothing moves before a new
start.
"""

from __future__ import annotations

import time
from pathlib import Path

import anyio
import pytest

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import DemoAgent, module_status
from roboneuron import NotReadyError

CONFIG = Path(__file__).parents[2] / "examples" / "pair.toml"
STILL_RAD = 0.002
PATIENCE_S = 60.0


async def _positions(agent: DemoAgent) -> dict[str, float]:
    answer = await agent.call("read_joint_states")
    messages = answer["messages"]
    assert isinstance(messages, list)
    newest = messages[-1]
    return dict(zip(newest["name"], newest["position"], strict=True))


async def _moved(agent: DemoAgent, pause_s: float) -> dict[str, float]:
    """Displacement of each arm's fastest joint in that time [rad]."""
    before = await _positions(agent)
    await anyio.sleep(pause_s)
    after = await _positions(agent)
    return {
        arm: max(abs(after[n] - before[n]) for n in after if n.startswith(f"{arm}_fr3_joint"))
        for arm in ("left", "right")
    }


async def _stop_while_they_move(log: Path) -> None:
    async with spawned_server(["--config", str(CONFIG)], log) as client:
        agent = DemoAgent(client)
        for tool in ("start_robot", "start_control"):  # a camera would only cost time here
            await agent.call(tool)
        positions = {f"{arm}_fr3_joint7": 2.4 for arm in ("left", "right")}
        async with anyio.create_task_group() as group:

            async def move() -> None:
                with pytest.raises(NotReadyError, match="stop"):
                    await agent.call("move_joints", {"positions": positions, "duration_s": 6.0})

            group.start_soon(move)
            until_s = time.monotonic() + PATIENCE_S
            while min((await _moved(agent, 0.2)).values()) < 10 * STILL_RAD:
                assert time.monotonic() < until_s, "the arms did not begin to move"
            await agent.call("emergency_stop")
        await anyio.sleep(0.3)
        assert max((await _moved(agent, 1.0)).values()) < STILL_RAD
        for name in ("robot", "control"):
            assert module_status(await agent.status(), name)["emergency_stop"]
        with pytest.raises(NotReadyError, match="stop"):
            await agent.call("move_joints", {"positions": {"right_fr3_joint1": 0.0}})


@pytest.mark.ros
@pytest.mark.timeout(180)
def test_both_arms_hold_when_one_stop_is_pressed(
    tmp_path: Path, environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ROS_DOMAIN_ID", "XDG_STATE_HOME"):  # the stop is latched there permanently
        monkeypatch.setenv(name, environment[name])
    anyio.run(_stop_while_they_move, tmp_path / "server.log")
