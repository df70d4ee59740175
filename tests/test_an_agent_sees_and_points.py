"""An agent that knows nothing but what tools answer, in a served FR3, judged by the simulator."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from itertools import product
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


async def moves(agent: SeeingAgent) -> None:
    moved = await agent.do(
        "move_to", position_m=[0.45, 0.1, 0.35], yaw_deg=20.0, above_m=0.05, speed=0.8
    )
    assert moved["position_m"] == pytest.approx([0.45, 0.1, 0.35], abs=0.005)
    assert moved["yaw_deg"] == pytest.approx(20.0, abs=1.5)
    assert 0.02 < moved["max_tcp_speed_m_s"] <= 0.25 * 1.1
    ((joint, margin),) = moved["joint_margin"].items()
    assert joint.startswith("fr3_joint")
    assert margin > 0
    first = (await agent.look())["objects"][0]
    over = {"mark": 1, "above_m": 0.12}
    preview = await agent.do("move_to", **over, simulate=True)
    assert preview["outcome"] == "reached"
    await agent.do("move_to", **over)
    hand = (await agent.look())["hands"][0]
    colour = first["name"].split()[0]
    cube = (await agent.truth())[colour]
    assert hand["position_m"][:2] == pytest.approx(cube[:2], abs=0.01)
    assert hand["position_m"] == pytest.approx(preview["position_m"], abs=0.01)
    await agent.do("move_to", name="home", speed=0.5)


async def picks(agent: SeeingAgent) -> None:
    seen = await agent.look()
    name = seen["objects"][0]["name"]
    preview = await agent.do("pick", object=name, simulate=True)
    assert preview["outcome"] == "reached", preview
    before = await agent.truth()
    picked = await agent.do("pick", mark=1)
    assert (picked["object"], picked["holds"]) == (name, True)
    after = await agent.truth()
    colour = name.split()[0]
    assert after[colour][2] - before[colour][2] > 0.05
    assert picked["grasped_at_m"] == pytest.approx(before[colour].tolist(), abs=0.01)
    for other in before.keys() - {colour}:
        assert np.linalg.norm(after[other] - before[other]) < 0.003
    assert picked["others_moved"] == []
    hand = (await agent.look())["hands"][0]
    assert hand["holding"] is True
    assert "place first" in await agent.fail("pick", object=name)


async def puts_down(agent: SeeingAgent) -> None:
    first = (await agent.look())["hands"][0]["holds"]
    colour = first.split()[0]
    truth = await agent.truth()
    other = next(name for name in truth if name != colour)
    preview = await agent.do("place", on=f"{other} cube", simulate=True)
    assert preview["outcome"] == "reached", preview
    placed = await agent.do("place", on=f"{other} cube")
    assert placed["holding"] is False
    after = await agent.truth()
    assert after[colour][:2] == pytest.approx(after[other][:2], abs=0.008)
    assert after[colour][2] - after[other][2] == pytest.approx(0.044, abs=0.006)
    assert "stands" in await agent.fail("pick", object=other)
    picked = await agent.do("pick", object=colour)
    assert picked["holds"] is True
    await agent.do("place", beside=other, side="+y", gap_m=0.05)
    after = await agent.truth()
    assert np.linalg.norm(after[colour][:2] - after[other][:2]) == pytest.approx(0.094, abs=0.012)
    assert after[colour][2] < 0.03


async def pushes(agent: SeeingAgent) -> None:
    """Push the first cube whose way is free in a direction."""
    await agent.do("move_to", name="home")
    names = [one["name"] for one in (await agent.look())["objects"]]
    told = []
    for name, (dx_m, dy_m) in product(names, ((0.05, 0.0), (0.0, 0.05), (0.0, -0.05))):
        asked = {"object": name, "dx_m": dx_m, "dy_m": dy_m}
        told.append(await agent.do("push", **asked, simulate=True))
        if told[-1]["outcome"] == "reached":
            break
    assert told[-1]["outcome"] == "reached", told
    colour = name.split()[0]
    before = await agent.truth()
    pushed = await agent.do("push", **asked)
    moved = (await agent.truth())[colour] - before[colour]
    assert moved[:2] == pytest.approx([dx_m, dy_m], abs=0.008), pushed
    assert [pushed["moved"][axis] for axis in ("dx_m", "dy_m")] == pytest.approx(
        moved[:2].tolist(), abs=0.006
    )


STEPS: list[Callable[[SeeingAgent], Awaitable[None]]] = [
    sees,
    points,
    moves,
    picks,
    puts_down,
    pushes,
]


def test_an_agent_sees_and_points(tmp_path: Path, environment: dict[str, str]) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))

    async def scenario() -> None:
        judged = {**environment, "ROBONEURON_SIMULATOR_TRUTH": "on"}
        async with client_of(config, judged, "--log-level", "error") as client:
            for step in STEPS:
                await step(SeeingAgent(client))

    anyio.run(scenario)
