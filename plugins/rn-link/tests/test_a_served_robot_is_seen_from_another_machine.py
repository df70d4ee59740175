"""`roboneuron serve` with all its modules on the robot's machine, and a ROS process of the project
on another one.

The member receives joint states and images. Its actions pass the limits and the emergency stop of
the robot's control module; it cannot control modules. A foreign node on the network receives
nothing and moves nothing.
"""

from __future__ import annotations

from pathlib import Path

import anyio
import pytest
from link_cells import MOVED_RAD, STILL_RAD, WATCHER, agent_of, moved_rad, tell, wait_for_count
from link_machines import Machine, Talker, impossible, machines
from link_pairs import pair

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]


async def serve_and_watch(robot: Machine, gpu: Machine, other: Machine) -> None:
    """Run the scenario."""
    async with agent_of(robot) as agent:
        for tool in ("start_robot", "start_perception", "start_control"):
            await agent.do(tool)
        far = gpu.talk("far", script=WATCHER)
        await anyio.to_thread.run_sync(check_seen, far)
        namespace = str(far.report()["namespace"])
        subnet = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
        alien = other.talk("alien", namespace, link=False, script=WATCHER, **subnet)
        tell(other, alien, "act")
        wait_until(lambda: alien.report(), 30.0, "the foreign node")
        assert moved_rad(far, 3.0) < STILL_RAD, "the foreign node acts"
        await agent.do("start_inference", instruction="pick up the red cube")
        wait_until(lambda: moved_rad(far) > MOVED_RAD, 30.0, "the arm moves by its own policy")
        await agent.do("stop_inference")
        tell(gpu, far, "ask")
        wait_until(lambda: far.report()["answer"] is not None, 30.0, "an answer")
        assert far.report()["answer"] is False, "a module obeys its server alone"
        wait_until(lambda: moved_rad(far) < STILL_RAD, 20.0, "the arm stands")
        tell(gpu, far, "act")
        wait_until(lambda: moved_rad(far) > MOVED_RAD, 20.0, "the arm moves by its actions")
        await agent.do("emergency_stop")
        wait_until(lambda: moved_rad(far) < STILL_RAD, 20.0, "the arm stands")
        assert moved_rad(far, 3.0) < STILL_RAD, "the member still acts"
        wait_for_count(far, "images", 5)
        await agent.do("stop_all")
        found = alien.report()
        assert (found["joint_states"], found["images"]) == (0, 0)
        assert not [one for one in found["nodes"] if "alien" not in one]


def check_seen(far: Talker) -> None:
    """Check that the member receives modules, joint states and images."""
    wait_for_count(far, "joint_states", 20)
    wait_for_count(far, "images", 5)
    modules = ("control", "perception", "robot")
    wait_until(lambda: all(one in str(far.report()["nodes"]) for one in modules), 20.0, "all nodes")


def test_a_served_robot_is_seen_and_stays_behind_its_gate(tmp_path: Path) -> None:
    with machines(tmp_path, "robot", "gpu", "other") as made:
        pair(made["robot"], made["gpu"])
        anyio.run(serve_and_watch, made["robot"], made["gpu"], made["other"])
