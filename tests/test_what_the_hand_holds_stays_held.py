"""A picked-up cube, by the simulator's ground truth: held by every way of moving the arm, and put
down with one call.

Then: limits tightened by the agent apply to direct motion and to the policy, and only a person can
loosen them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest

from rn_simulation.engine import ENGINES
from rn_testing.agent import Agent, client_of
from roboneuron.plugins.availability import is_importable

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "servo"
[control]
controller = "urdf"
[plugins.fr3]
engine = "{engine}"
[supervisor]
start_timeout_s = 180.0
state_directory = "{state}"
"""
LEFT_M = 0.3
"""To where no other cube of the scene stands."""
STILL_M, SETTLE_S = 0.0005, 30.0
NEAR_M = 0.02
"""A cube released 2 mm above the table, by fingers that open one after the other, may slide."""


class CubeAgent(Agent):
    """Reads the cubes' ground truth."""

    async def status(self, module: str) -> dict[str, Any]:
        modules = (await self.do("get_status", details=True))["modules"]
        found: dict[str, Any] = next(m for m in modules if m["module"] == module)
        return found

    async def cube(self, colour: str) -> dict[str, Any]:
        cubes = json.loads((await self.status("robot"))["detail"]["cubes"])
        found: dict[str, Any] = cubes[colour]
        return found

    async def held_cube(self, colour: str) -> dict[str, Any]:
        """The cube once the hand that holds it is at rest, because a report may be older than the
        last call, and an arm that was just stopped still brakes.
        """
        found = await self.cube(colour)
        with anyio.fail_after(SETTLE_S):
            while True:
                await anyio.sleep(0.1)
                before, found = found, await self.cube(colour)
                rose_m = abs(found["lifted_m"] - before["lifted_m"])
                if found["held_s"] > before["held_s"] and rose_m < STILL_M:
                    return found

    async def says_tightened(self) -> None:
        """Control reports that its limits are tightened; a report may be older than the call."""
        with anyio.fail_after(SETTLE_S):
            while (await self.status("control"))["metrics"]["limits"] != "tightened":
                await anyio.sleep(0.1)


async def keeps_what_it_holds(agent: CubeAgent) -> None:
    await agent.do("start_all")
    await agent.do("run_task", instruction="pick up the green cube", max_s=90.0)
    await agent.do("stop_inference")
    before = await agent.held_cube("green")
    assert before["lifted_m"] > 0.1

    asked = await agent.do("move_ee", dz_m=0.02, simulate=True)
    assert (asked["simulated"], asked["allowed"]) == (True, True)
    assert asked["duration_s"] > 0.0
    moved = await agent.do("move_ee", dz_m=0.02)
    assert moved["position_m"] == pytest.approx(asked["position_m"], abs=0.005)
    assert (moved["holding"], moved["lost_on_the_way"]) == (True, False)
    after = await agent.held_cube("green")
    assert after["lifted_m"] == pytest.approx(before["lifted_m"] + 0.02, abs=0.006)
    assert after["held_s"] > before["held_s"]

    joints = (await agent.do("read_joint_states"))["messages"][0]
    last = joints["position"][joints["name"].index("fr3_joint7")]
    turned = await agent.do("move_joints", positions={"fr3_joint7": last + 0.2})
    assert turned["holding"] is True
    assert turned["error"] < 0.002, "it answers at rest"
    assert (await agent.held_cube("green"))["lifted_m"] > 0.1


async def puts_it_down(agent: CubeAgent) -> None:
    there = (await agent.held_cube("green"))["position_m"]
    placed = await agent.do("place", dy_m=LEFT_M)
    assert placed["holding"] is False
    with anyio.fail_after(SETTLE_S):  # a report may be older than the call
        while abs((cube := await agent.cube("green"))["lifted_m"]) >= 0.005:
            await anyio.sleep(0.1)
    assert cube["position_m"][:2] == pytest.approx([there[0], there[1] + LEFT_M], abs=NEAR_M)
    assert "holds nothing" in await agent.fail("place", dy_m=0.1)


async def keeps_to_tightened_limits(agent: CubeAgent) -> None:
    await agent.do("move_to", name="home")
    limits = await agent.do("tighten_limits", max_speed_m_s=0.05, y_max_m=0.1)
    assert limits["is_tightened"]
    assert (limits["max_speed_m_s"], limits["upper_m"][1]) == (0.05, 0.1)
    told = (await agent.do("get_status"))["tightened_limits"]
    assert (told["max_speed_m_s"], told["workspace_upper_m"][1]) == (0.05, 0.1)
    await agent.says_tightened()

    slow = await agent.do("move_ee", dx_m=0.1)
    assert slow["duration_s"] > 0.1 / 0.05
    assert "outside the workspace" in await agent.fail("move_ee", dy_m=0.2)
    assert "outside the workspace" in await agent.fail("move_joints", positions={"fr3_joint1": 0.6})

    wider = await agent.do("tighten_limits", max_speed_m_s=0.3)
    assert wider["max_speed_m_s"] == 0.05, "tighter stays tighter"
    await agent.do("stop_control")
    await agent.do("start_control")
    await agent.says_tightened()
    assert "roboneuron robot limits --loosen" in await agent.fail("loosen_limits")


@pytest.mark.parametrize("engine", [engine for engine in ENGINES if is_importable(engine)])
def test_a_cube_stays_held_until_it_is_put_down(
    tmp_path: Path, environment: dict[str, str], engine: str, request: pytest.FixtureRequest
) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state", engine=engine))
    steps: list[Callable[[CubeAgent], Any]] = [
        keeps_what_it_holds,
        puts_it_down,
        keeps_to_tightened_limits,
    ]

    async def scenario() -> None:
        judged = {**environment, "ROBONEURON_SIMULATOR_TRUTH": "on"}
        async with client_of(config, judged, "--log-level", "error") as client:
            for step in steps:
                await step(CubeAgent(client))

    anyio.run(scenario)
    audit = [
        json.loads(line) for line in (tmp_path / "state" / "audit.jsonl").read_text().splitlines()
    ]
    tightened = [line["arguments"] for line in audit if line["verdict"] == "tightened"]
    assert tightened == [{"max_speed_m_s": 0.05, "y_max_m": 0.1}]
