"""A second server on the other machine: two robots, two agents, one link. Each agent moves its own
robot and reads the other's; a cut cable stops neither robot, and both machines report it.
"""

from __future__ import annotations

import json
from pathlib import Path

import anyio
import pytest
from link_cells import agent_of, until_connected
from link_machines import Machine, impossible, machines
from link_pairs import pair

from rn_testing.agent import Agent

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
ARM = """
[robot]
name = "fr3"
[control]
controller = "urdf"
[[expose]]
name = "far_odom"
kind = "read"
topic = "/diffdrive/odom"
type = "nav_msgs/msg/Odometry"
"""
BASE = """
[robot]
name = "diffdrive"
[[expose]]
name = "far_joints"
kind = "read"
topic = "/fr3/joint_states"
type = "sensor_msgs/msg/JointState"
"""


async def odometry(agent: Agent, tool: str) -> float:
    """Position of the base along x, read from one of the servers."""
    read = await agent.do(tool, timeout_s=30.0)
    x_m = read["messages"][0]["pose"]["pose"]["position"]["x"]
    assert isinstance(x_m, float)
    return x_m


async def use_both(arm: Agent, base: Agent, robot: Machine, gpu: Machine) -> None:
    """Run the scenario."""
    await arm.do("start_robot")
    await arm.do("start_control")
    await base.do("start_robot")
    linked = [await until_connected(robot, "gpu", True), await until_connected(gpu, "robot", True)]
    assert all(one.error == "" for one in linked)
    # each agent reads the other's robot, and moves its own
    near = await base.do("read_far_joints", timeout_s=30.0)
    assert "fr3_joint1" in near["messages"][0]["name"]
    twist = {"linear": {"x": 0.2}}
    await base.do("publish_velocity", message=twist, duration_s=2.0, timeout_s=30.0)
    assert await odometry(arm, "read_far_odom") > 0.2
    await arm.do("move_ee", dz_m=-0.03)
    status = json.dumps(await base.do("get_status"))
    assert "fr3_joint1" not in status, "the arm's modules are of the other server"
    # a stop of one robot does not affect the other
    await arm.do("emergency_stop")
    succeeded, _, _ = await arm.call("move_ee", dz_m=0.03)
    assert not succeeded
    before_m = await odometry(arm, "read_far_odom")
    await base.do("publish_velocity", message=twist, duration_s=1.0)
    assert await odometry(arm, "read_far_odom") > before_m + 0.1
    # a cut cable stops neither, and is reported on both sides
    gpu.cut()
    cut = await until_connected(robot, "gpu", False)
    assert "Is gpu on, 10.213.91.2 its address, and its TCP port 7411 open?" in cut.hint, cut
    assert (await until_connected(gpu, "robot", False)).hint
    await base.do("publish_velocity", message=twist, duration_s=1.0)
    await arm.do("read_joint_states", timeout_s=10.0)
    succeeded, _, text = await arm.call("read_far_odom", timeout_s=2.0)
    assert not succeeded, "the cable is cut"
    assert "nothing came" in text or "Nobody publishes" in text
    gpu.plug()
    await until_connected(robot, "gpu", True)
    await until_connected(gpu, "robot", True)
    assert await odometry(arm, "read_far_odom") > before_m


def test_two_servers_share_a_link(tmp_path: Path) -> None:
    async def scenario() -> None:
        with machines(tmp_path, "robot", "gpu") as made:
            pair(made["robot"], made["gpu"])
            async with (
                agent_of(made["robot"], ARM) as arm,
                agent_of(made["gpu"], BASE) as base,
            ):
                await use_both(arm, base, made["robot"], made["gpu"])

    anyio.run(scenario)
