"""Previews of a served FR3: nothing is published for them, and their predictions then come true."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from rn_testing.agent import Agent, client_of
from rn_testing.waiting import wait_until

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
[simulate]
limit_s = 60.0
[supervisor]
state_directory = "{state}"
"""
LISTENER = """
import rclpy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

rclpy.init()
node = rclpy.create_node("listener", namespace="fr3")
for kind, topic in (
    (JointTrajectory, "joint_trajectory"),
    (JointState, "joint_command"),
    (Float64MultiArray, "action"),
):
    node.create_subscription(kind, topic, lambda _, topic=topic: print(topic, flush=True), 10)
print("up", flush=True)
rclpy.spin(node)
"""
HOLDS = {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.85}
PLACES: tuple[tuple[int, dict[str, float]], ...] = (
    (3, {"dx_m": 0.05, "dy_m": -0.12}),
    (4, {"dx_m": -0.06, "dy_m": -0.1, "height_m": 0.12}),
    (5, {"dx_m": 0.4}),
)
"""Scene, and where its red cube is put; the last place is out of reach."""
NEAR_M = 0.004
"""Two millimetres each for the end of move_ee in the twin and in the cell."""


@pytest.fixture
def heard(tmp_path: Path, environment: dict[str, str]) -> Iterator[Path]:
    """A file with one line per message that could move the arm."""
    path = tmp_path / "heard.txt"
    with path.open("w") as out:
        process = subprocess.Popen([sys.executable, "-c", LISTENER], stdout=out, env=environment)
    try:
        wait_until(lambda: path.read_text().startswith("up"), 60.0)
        yield path
    finally:
        process.kill()
        process.wait(10)


def test_simulated_calls_publish_nothing_and_come_true(
    tmp_path: Path, environment: dict[str, str], heard: Path
) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))

    def lines() -> int:
        return len(heard.read_text().splitlines())

    async def scenario() -> None:
        async with client_of(config, environment, timeout_s=90.0) as client:
            do = Agent(client).do

            async def joints() -> Any:
                state = (await do("read_joint_states"))["messages"][0]
                return np.array(state["position"][:7])

            await do("start_robot")
            await do("start_control")
            turn = {"positions": {"fr3_joint1": -0.3}}
            await do("move_joints", **turn, simulate=True)  # messages of the start have arrived now
            before, start = lines(), await joints()
            reach = {"dx_m": 0.06, "dy_m": -0.05, "dz_m": -0.1}
            promise = await do("move_ee", **reach, simulate=True)
            assert promise["outcome"] == "reached"
            assert promise["now"] == ""
            stopped = await do("move_ee", dy_m=0.45, simulate=True)
            assert (stopped["outcome"], stopped["rule"]) == ("stopped", "zone")
            turned = await do("move_joints", **turn, simulate=True)
            assert turned["outcome"] == "reached"
            assert np.abs(await joints() - start).max() < 1e-3
            assert lines() == before

            moved = await do("move_ee", **reach)
            assert np.linalg.norm(np.subtract(moved["position_m"], promise["position_m"])) < NEAR_M
            assert lines() > before
            refused = await client.call_tool("move_ee", {"dy_m": 0.45})
            assert refused.is_error
            assert "would enter 'person'" in refused.content[0].text  # type: ignore[union-attr]

            await do("emergency_stop", reason="a test")
            await do("move_joints", **turn, simulate=True)  # as has the hold of the stop
            still, start = lines(), await joints()
            looked = await do("move_joints", **turn, simulate=True)
            assert "mergency stop" in looked["now"]
            assert np.abs(await joints() - start).max() < 1e-3
            assert lines() == still
            await do("stop_all")

    anyio.run(scenario)


@pytest.mark.timeout(600)
def test_a_place_ends_as_it_was_simulated(tmp_path: Path, environment: dict[str, str]) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))

    async def scenario() -> None:
        async with client_of(config, environment, timeout_s=120.0) as client:
            do = Agent(client).do

            for seed, place in PLACES:
                await do("start_robot", options={"seed": seed})
                await do("start_all")
                until = {"kind": "held", "for_s": 0.5, "of": HOLDS}
                picked = await do("run_task", instruction="pick up the red cube", until=until)
                assert picked["outcome"] == "succeeded"
                await do("stop_inference")
                told = await do("place", **place, simulate=True)
                happened = await client.call_tool("place", place)
                assert happened.is_error is (told["outcome"] != "reached"), (told, happened)
                if not happened.is_error:
                    pose = (await do("read_ee_pose"))["messages"][0]["pose"]["position"]
                    end_m = [pose["x"], pose["y"], pose["z"]]
                    assert np.linalg.norm(np.subtract(end_m, told["position_m"])) < NEAR_M
                    assert "red cube" in told["would_move"]  # the one in the hand
                    assert happened.structured_content["holding"] is False
                else:
                    assert told["reason"]
                await do("stop_all")

    anyio.run(scenario)
