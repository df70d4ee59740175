"""An agent that knows nothing but what tools answer, in a served FR3, judged by the simulator."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from rn_testing.agent import Agent, client_of

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[control]
controller = "urdf"
[plugins.fr3-sim-camera]
width = 640
height = 480
[supervisor]
start_timeout_s = 180.0
state_directory = "{state}"
"""
LOOK_S = 1.0


class SeeingAgent(Agent):
    """Looks; the simulator's truth is for the judge."""

    async def look(self) -> dict[str, Any]:
        seen: dict[str, Any] = await self.do("look")
        return seen

    async def truth(self) -> dict[str, np.ndarray[Any, np.dtype[np.float64]]]:
        modules = (await self.do("get_status"))["modules"]
        robot = next(m for m in modules if m["module"] == "robot")
        cubes = json.loads(robot["detail"]["cubes"])
        return {name: np.array(cube["position_m"]) for name, cube in cubes.items()}


async def sees(agent: SeeingAgent) -> None:
    blind = await agent.do("look")
    assert blind["objects"] == []
    assert "start_perception" in blind["problems"]["front"]
    for kind in ("robot", "perception"):
        await agent.do(f"start_{kind}")
    one_eyed = await agent.look()
    assert "start_control" in one_eyed["problems"]["wrist"]
    await agent.do("start_control")
    seen = await agent.look()
    assert seen["problems"] == {}
    assert seen["took_s"] < LOOK_S
    truth = await agent.truth()
    assert len(seen["objects"]) == len(truth)
    for one in seen["objects"]:
        off_m = np.linalg.norm(truth[one["name"].split()[0]] - one["position_m"])
        assert off_m <= 2 * one["uncertainty_m"], one
    assert [hand["holding"] for hand in seen["hands"]] == [None], "nothing was commanded yet"


async def points(agent: SeeingAgent) -> None:
    seen = await agent.look()
    front = next(one for one in seen["pictures"] if one["camera"] == "front")
    for mark, pixel in front["marks_px"].items():
        place = await agent.do("locate", camera="front", pixel=[float(v) for v in pixel])
        assert (place["surface"], place["mark"]) == ("object", int(mark))
    told = await agent.fail("locate", camera="front", pixel=[9999.0, 0.0])
    assert "outside the picture" in told


STEPS: list[Callable[[SeeingAgent], Awaitable[None]]] = [sees, points]


def test_an_agent_sees_and_points(tmp_path: Path, environment: dict[str, str]) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))

    async def scenario() -> None:
        judged = {**environment, "ROBONEURON_SIMULATOR_TRUTH": "on"}
        async with client_of(config, judged, "--log-level", "error") as client:
            for step in STEPS:
                await step(SeeingAgent(client))

    anyio.run(scenario)
