"""An agent sends FollowJointTrajectory goals as a typed tool: every point is within the limits of
the arm, feedback is progress, and a cancelled goal leaves the arm at rest.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD
from rn_testing.agent import Agent, client_of
from rn_testing.domain import free_ros_domain
from roboneuron.ros.environment import prepare_environment
from roboneuron.ros.link import RosLink

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
CONFIG = """
[robot]
name = "fr3"
driver = "ros2-control"
namespace = "cell"
[plugins.fr3]
controller = "/fr3_arm_controller"
connect_timeout_s = 60.0
state_timeout_s = 3.0
[control]
controller = "urdf"
[supervisor]
state_directory = "{state}"
[[expose]]
name = "follow"
kind = "action"
topic = "/fr3_arm_controller/follow_joint_trajectory"
type = "control_msgs/action/FollowJointTrajectory"
"""


def goal(*points: tuple[float, float]) -> dict[str, Any]:
    """The last joint goes so far from its start, at these times [s]."""
    return {
        "trajectory": {
            "joint_names": list(ARM_JOINTS),
            "points": [
                {
                    "positions": [*(float(q) for q in HOME_RAD[:6]), float(HOME_RAD[6]) + step],
                    "time_from_start": at_s,
                }
                for step, at_s in points
            ],
        }
    }


class ArmAgent(Agent):
    """Reads its last joint."""

    async def last_joint(self) -> float:
        """How far the joint is measured from its start."""
        _, read, text = await self.call("read_joint_states", timeout_s=30.0)
        message = read["messages"][0]
        place = message["position"][message["name"].index(ARM_JOINTS[6])]
        assert isinstance(place, float), text
        return place - float(HOME_RAD[6])


@asynccontextmanager
async def agent_of(folder: Path, environment: dict[str, str]) -> AsyncIterator[ArmAgent]:
    config = folder / "roboneuron.toml"
    config.write_text(CONFIG.format(state=folder / "state"))
    async with client_of(config, environment) as client:
        agent = ArmAgent(client)
        started, _, text = await agent.call("start_robot")
        assert started, text
        yield agent


@pytest.fixture
def environment(tmp_path: Path) -> Iterator[dict[str, str]]:
    """That of a server beside a controller."""
    made = {**os.environ, "ROS_DOMAIN_ID": str(free_ros_domain())}
    made["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    made["AMENT_PREFIX_PATH"] = sys.prefix
    command = [
        *(sys.executable, "-m", "rn_driver_ros2control.standin_node"),
        *("--controller", "/fr3_arm_controller", "--joints", *ARM_JOINTS),
        *("--start", *(str(value) for value in HOME_RAD)),
    ]
    with (
        (tmp_path / "controller.log").open("wb") as log,
        subprocess.Popen(command, env=made, stdout=log, stderr=log) as process,
    ):
        yield made
        process.terminate()


def test_goals_are_followed_within_the_limits_of_every_point(
    environment: dict[str, str], tmp_path: Path
) -> None:
    async def scenario() -> None:
        async with agent_of(tmp_path, environment) as agent:
            for bad, told in (
                (goal((0.1, 1.0), (9.0, 2.0)), "points[1]: position of fr3_joint7"),
                (goal((0.1, 1.0), (0.9, 1.1)), "points[1]: fr3_joint7 would move at"),
                (goal((0.1, 1.0), (0.2, 1.0)), "points[1]: time_from_start"),
            ):
                succeeded, _, text = await agent.call("send_follow_goal", goal=bad)
                assert not succeeded
                assert told in text
            assert await agent.last_joint() == pytest.approx(0.0, abs=1e-3)
            whole = goal((0.1, 1.0), (0.2, 2.0))
            succeeded, answer, text = await agent.call(
                "send_follow_goal", goal=whole, server_timeout_s=30.0
            )
            assert succeeded, text
            assert answer["feedbacks"] > 10
            assert any("desired" in told for told in agent.told)
            assert await agent.last_joint() == pytest.approx(0.2, abs=2e-3)
            succeeded, _, text = await agent.call(
                "send_follow_goal", goal=goal((1.2, 20.0)), timeout_s=1.0
            )
            assert not succeeded
            assert "did not end within 1 s" in text
            rested = await agent.last_joint()
            assert 0.2 < rested < 0.5
            await anyio.sleep(0.5)
            assert await agent.last_joint() == pytest.approx(rested, abs=1e-3)

    anyio.run(scenario)


@pytest.mark.exhaustive
def test_a_goal_that_another_command_replaces_is_not_reached(
    environment: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The controller tells the end of the other command as that of the goal."""
    monkeypatch.setenv("ROS_DOMAIN_ID", environment["ROS_DOMAIN_ID"])
    prepare_environment(tmp_path / "ros")
    foreign = RosLink("foreign")
    foreign.open()
    send = foreign.advertise(JointTrajectory, "/fr3_arm_controller/joint_trajectory")

    async def scenario() -> None:
        async with agent_of(tmp_path, environment) as agent:

            async def replace() -> None:
                while abs(await agent.last_joint()) < 0.02:
                    await anyio.sleep(0.02)
                point = JointTrajectoryPoint(positions=[float(q) for q in HOME_RAD])
                point.time_from_start.nanosec = 300_000_000
                send(JointTrajectory(joint_names=list(ARM_JOINTS), points=[point]))

            async with anyio.create_task_group() as group:
                group.start_soon(replace)
                succeeded, _, text = await agent.call(
                    "send_follow_goal", goal=goal((1.2, 10.0)), server_timeout_s=30.0
                )
            assert not succeeded
            assert "reports that its goal is reached, but fr3_joint7 is measured 1.2" in text

    try:
        anyio.run(scenario)
    finally:
        foreign.close()
