"""An agent moves a simulated FR3 with MoveIt's actions, through the tools generated from their
definitions: to a position, by a plan, never where the limits forbid it, and to rest when it stops.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_testing.agent import Agent, client_of
from rn_testing.waiting import wait_for_line
from roboneuron import JointSample

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
EXAMPLES = Path(__file__).parents[1] / "examples"
CONFIG = """
[robot]
name = "fr3"
[control]
controller = "urdf"
[limits]
velocity_fraction = 0.6
acceleration_fraction = 0.6
[[limits.zones]]
name = "cup"
lower_m = [0.25, 0.12, 0.0]
upper_m = [0.35, 0.20, 0.7]
[supervisor]
state_directory = "{state}"
[[expose]]
name = "arm"
kind = "action"
topic = "move_action"
type = "moveit_msgs/action/MoveGroup"
[[expose]]
name = "plan"
kind = "action"
topic = "execute_trajectory"
type = "moveit_msgs/action/ExecuteTrajectory"
"""


def goal(
    constraints: dict[str, Any], speed: float = 0.5, group: str = "fr3_arm", **options: Any
) -> dict[str, Any]:
    """A goal of MoveGroup."""
    kept = {"is_diff": True, "robot_state": {"is_diff": True}}
    return {
        "request": {
            "group_name": group,
            "start_state": {"is_diff": True},
            "goal_constraints": [constraints],
            "max_velocity_scaling_factor": speed,
            "max_acceleration_scaling_factor": speed,
        },
        "planning_options": {"planning_scene_diff": kept, **options},
    }


def joints(**to: float) -> dict[str, Any]:
    """Constraints for every joint, relative to home."""
    at = dict(zip(ARM_JOINTS, map(float, HOME_RAD), strict=True)) | to
    return {
        "joint_constraints": [
            {
                "joint_name": name,
                "position": position,
                "tolerance_above": 0.01,
                "tolerance_below": 0.01,
                "weight": 1.0,
            }
            for name, position in at.items()
        ]
    }


def place(x: float, y: float, z: float) -> dict[str, Any]:
    """Constraints of the TCP."""
    region = {
        "primitives": [{"type": "SPHERE", "dimensions": [0.002]}],
        "primitive_poses": [{"position": {"x": x, "y": y, "z": z}}],
    }
    return {
        "position_constraints": [
            {
                "header": {"frame_id": "fr3_link0"},
                "link_name": "fr3_hand_tcp",
                "constraint_region": region,
                "weight": 1.0,
            }
        ]
    }


class ArmAgent(Agent):
    """Moves an arm."""

    async def move(self, to: dict[str, Any], **more: Any) -> tuple[bool, dict[str, Any], str]:
        """Send a goal; the first one waits for the discovery of the action server."""
        return await self.call("send_arm_goal", goal=to, server_timeout_s=30.0, **more)

    async def refused(self, to: dict[str, Any], told: str) -> None:
        """Check that a goal ends in an error with this text."""
        succeeded, _, text = await self.move(to)
        assert not succeeded
        assert told in text, text

    async def joints(self) -> dict[str, float]:
        """Measured joint positions."""
        succeeded, read, text = await self.call("read_joint_states", timeout_s=30.0)
        assert succeeded, text
        message = read["messages"][0]
        return dict(zip(message["name"], message["position"], strict=True))

    async def turn(self) -> float:
        """Measured position of the first joint."""
        return (await self.joints())[ARM_JOINTS[0]]

    async def rest(self) -> float:
        """Position of the first joint at rest."""
        before = await self.turn()
        with anyio.fail_after(30.0):
            while True:
                await anyio.sleep(0.3)
                now = await self.turn()
                if abs(now - before) < 1e-3:
                    return now
                before = now

    async def tcp(self) -> list[float]:
        """TCP position from the measured joints [m]."""
        measured = await self.joints()
        names, positions = tuple(measured), np.array(list(measured.values()))
        kinematics = UrdfController(None, profile())
        kinematics.load()
        pose = kinematics.forward(JointSample(names=names, position=positions))
        return [float(value) for value in pose.position_m]


class Cell:
    """A planner, and the environment of a server."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self._folder, self._environment = folder, environment
        command = [sys.executable, str(EXAMPLES / "moveit_standin.py"), "--namespace", "fr3"]
        self._planner = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, text=True
        )
        wait_for_line(self._planner.stdout, "move_action is offered")

    @asynccontextmanager
    async def agent(self) -> AsyncIterator[ArmAgent]:
        """A client of a server with a started arm."""
        config = self._folder / "roboneuron.toml"
        config.write_text(CONFIG.format(state=self._folder / "state"))
        async with client_of(config, self._environment) as client:
            made = ArmAgent(client)
            started, _, text = await made.call("start_robot")
            assert started, text
            yield made

    def close(self) -> None:
        self._planner.terminate()
        self._planner.communicate(timeout=30)


@pytest.fixture
def cell(tmp_path: Path, learnt_environment: dict[str, str]) -> Iterator[Cell]:
    made = Cell(tmp_path, learnt_environment)
    yield made
    made.close()


def test_an_arm_goes_where_it_may_by_goals_and_by_plans(cell: Cell) -> None:
    async def scenario() -> None:
        async with cell.agent() as agent:
            await agent.refused(goal(joints(), speed=0.7), "at most 0.6")
            await agent.refused(goal(joints(fr3_joint1=3.0)), "fr3_joint1 may come to")
            await agent.refused(goal(place(0.3, 0.15, 0.4)), "'cup'")
            await agent.refused(goal(joints(fr3_joint1=0.5)), "'cup'")
            assert abs(await agent.turn()) < 1e-3, "a refused goal moved it"
            succeeded, answer, text = await agent.move(goal(place(0.4, -0.1, 0.3)))
            assert succeeded, text
            assert answer["result"]["error_code"]["val"] == "SUCCESS"
            assert any("MONITOR" in told for told in agent.told)
            assert await agent.tcp() == pytest.approx([0.4, -0.1, 0.3], abs=0.01)
            # a failure of the planner is an error with its code
            await agent.refused(goal(joints(), group="left"), "INVALID_GROUP_NAME")
            await agent.refused(goal(place(0.74, 0.44, 0.74)), "NO_IK_SOLUTION")
            # planned only: nothing moves, and the plan is checked again before its execution
            succeeded, answer, text = await agent.move(goal(joints(), plan_only=True))
            assert succeeded, text
            assert await agent.tcp() == pytest.approx([0.4, -0.1, 0.3], abs=0.01)
            plan = answer["result"]["planned_trajectory"]["joint_trajectory"]
            send = {"goal": {"trajectory": {"joint_trajectory": plan}}, "server_timeout_s": 30.0}
            succeeded, answer, text = await agent.call("send_plan_goal", **send)
            assert succeeded, text
            assert await agent.tcp() == pytest.approx([0.307, 0.0, 0.487], abs=0.01)
            plan["points"] = plan["points"][-1:]
            plan["points"][0]["positions"][0] = 2.0
            succeeded, _, text = await agent.call("send_plan_goal", **send)
            assert not succeeded
            assert "fr3_joint1 would move at" in text

    anyio.run(scenario)


async def ended(agent: Any, wanted: Any, **options: float) -> tuple[bool, str]:
    """Whether a motion succeeded, and its text; one that a stall of a busy machine has ended is
    asked for again.
    """
    for _ in range(4):
        succeeded, _, text = await agent.move(wanted, **options)
        if not any(
            word in text for word in ("was frozen", "not measured any more", "sign of life")
        ):
            break
    return succeeded, text


def test_an_arm_stops_where_it_may_not_be_and_when_it_is_told_to(cell: Cell) -> None:
    async def scenario() -> None:
        async with cell.agent() as agent:
            # on the other side of the zone, which the planner does not know: the robot module
            # refuses its way, and the planner's controller sees no motion
            before = await agent.turn()
            succeeded, text = await ended(agent, goal(joints(fr3_joint1=0.74), speed=0.1))
            assert not succeeded
            assert "The controller is too slow" in text or "TIMED_OUT" in text
            assert await agent.turn() == pytest.approx(before, abs=0.01), "it moved to the zone"
            away = goal(joints(fr3_joint1=-0.6), speed=0.1)
            succeeded, text = await ended(agent, away, timeout_s=1.0)
            assert not succeeded
            assert "did not end within 1 s" in text
            assert await agent.rest() > -0.5, "it went on to its goal"
            answers: list[tuple[bool, dict[str, Any], str]] = []

            async def go() -> None:
                answers.append(await agent.move(away))

            agent.told.clear()
            async with anyio.create_task_group() as group:
                group.start_soon(go)
                with anyio.fail_after(30.0):
                    while not any("MONITOR" in told for told in agent.told):
                        await anyio.sleep(0.05)
                await agent.call("emergency_stop")
            succeeded, _, text = answers[0]
            assert not succeeded
            assert "emergency stop" in text.lower()
            assert await agent.rest() > -0.5, "it went on to its goal"
            await agent.refused(goal(joints()), "emergency stop")

    anyio.run(scenario)
