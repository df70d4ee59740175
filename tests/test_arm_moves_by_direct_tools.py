"""The simulated FR3 moved by direct tools only: joint targets, a trajectory, end-effector deltas,
refusals.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anyio
import pytest

from rn_testing.agent import Agent, client_of

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "servo"
[control]
controller = "urdf"
[[limits.zones]]
name = "person"
lower_m = [0.22, 0.12, 0.0]
upper_m = [0.40, 0.30, 0.7]
[limits]
obstacles = [
    {{ name = "table", lower_m = [-0.3, -0.6, -0.6], upper_m = [1.0, 0.6, 0.0] }},
    {{ name = "lamp", lower_m = [0.25, -0.35, 0.02], upper_m = [0.35, -0.25, 0.8] }},
]
[supervisor]
state_directory = "{state}"
"""
REACHED_M = 0.004
"""The move ends within 2 mm; the rest is drift of the arm until it is measured again."""


def test_joints_trajectory_and_end_effector(tmp_path: Path, environment: dict[str, str]) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))

    async def scenario() -> None:
        async with client_of(config, environment, "--log-level", "error") as client:
            do = Agent(client).do

            async def fail(tool: str, **arguments: Any) -> str:
                answer = await client.call_tool(tool, arguments)
                assert answer.is_error, answer.structured_content
                return answer.content[0].text  # type: ignore[union-attr]

            assert "Call start_robot first" in await fail(
                "move_joints", positions={"fr3_joint1": 0.1}
            )
            await do("start_robot")
            assert "control is not running" in await fail("move_ee", dx_m=0.05)
            await do("start_control")

            moved = await do(
                "move_joints", positions={"fr3_joint1": 0.2, "fr3_finger_joint1": 0.02}
            )
            assert moved["error"] < 0.01
            assert abs(moved["position"]["fr3_joint1"] - 0.2) < 0.01

            before = (await do("read_ee_pose"))["messages"][0]["pose"]["position"]
            delta = await do(
                "move_ee", dx_m=0.04, dy_m=-0.03, dz_m=-0.05, rz_rad=0.2, gripper_open=1.0
            )
            assert delta["error_m"] < REACHED_M
            assert delta["error_rad"] < 0.03
            after = (await do("read_ee_pose"))["messages"][0]["pose"]["position"]
            for axis, asked in (("x", 0.04), ("y", -0.03), ("z", -0.05)):
                assert abs(after[axis] - before[axis] - asked) < REACHED_M

            assert "too fast" in await fail("move_ee", dx_m=0.3, duration_s=0.2)
            assert "asks for no move" in await fail("move_ee")
            text = await fail("move_ee", dz_m=-0.5)
            assert "short" in text
            assert "holding" in text

            # into the table; through the zone to its other side
            for arguments in ({"dz_m": -0.5}, {"dy_m": 0.45}):
                asked = await do("move_ee", **arguments, simulate=True)
                assert not asked["allowed"], asked
                assert "short" in asked["reason"]
                assert "holding" in asked["reason"]
            assert "would enter 'person'" in asked["reason"]
            state = (await do("read_joint_states"))["messages"][0]
            assert "would enter 'person'" in await fail("move_ee", dy_m=0.45)
            await do(
                "move_joints",
                positions=dict(zip(state["name"][:7], state["position"][:7], strict=True)),
            )
            free = await do("move_ee", dx_m=0.03, dz_m=0.05, simulate=True)
            assert free["allowed"], free
            assert free["simulated"]

            point = {"positions": [0.0], "time_from_start": 1.5}
            sent = await do(
                "publish_joint_trajectory",
                message={"joint_names": ["fr3_joint1"], "points": [point]},
            )
            assert sent["subscribers"] == 1
            quick = {"positions": [2.0], "time_from_start": 0.1}
            text = await fail(
                "publish_joint_trajectory",
                message={"joint_names": ["fr3_joint1"], "points": [quick]},
            )
            assert "fr3_joint1 would move at" in text

            for tool, arguments in (
                ("move_joints", {"positions": {"fr3_joint1": 0.6}}),
                ("publish_joint_trajectory", {"message": {"joint_names": ["fr3_joint1"], "points": [
                    {"positions": [0.6], "time_from_start": 8.0}]}}),
            ):  # fmt: skip
                assert "would enter 'person'" in await fail(tool, **arguments)
                assert not (await do(tool, **arguments, simulate=True))["allowed"]
            assert "fr3_hand and lamp would be" in await fail(
                "move_joints", positions={"fr3_joint1": -0.6}
            )

            await do("start_perception")
            await do("start_inference")
            await do("move_ee", dx_m=0.02)  # the policy has no instruction
            await do("set_instruction", instruction="pick up the red cube")
            for tool, arguments in (
                ("move_ee", {"dx_m": 0.02}),
                ("move_joints", {"positions": {"fr3_joint1": 0.1}}),
            ):
                text = await fail(tool, **arguments)
                assert "The policy 'servo' moves 'fr3'" in text
            await do("stop_motion")
            await do("stop_inference")
            await do("move_to", name="home")  # the policy was stopped anywhere

            stopped: list[str] = []

            async def move() -> None:
                stopped.append(
                    await fail("move_joints", positions={"fr3_joint1": -0.25}, duration_s=8.0)
                )

            async with anyio.create_task_group() as group:
                group.start_soon(move)
                await anyio.sleep(1.0)
                await do("emergency_stop")
            assert "The emergency stop is latched" in stopped[0]
            joints = (await do("read_joint_states"))["messages"][0]
            assert joints["position"][joints["name"].index("fr3_joint1")] > -0.2

    anyio.run(scenario)
