"""An inference module alone on another machine, connected by ROS over the link: `roboneuron serve`
on that machine starts it; robot, cameras and control run on the robot's machine.
"""

from __future__ import annotations

import time
from pathlib import Path

import anyio
import pytest
from link_cells import MOVED_RAD, STILL_RAD, WATCHER, agent_of, moved_rad
from link_machines import Machine, impossible, machines
from link_pairs import pair

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
HOLDS_S = 3.0
"""Time after a cut cable: the longest age of an action, with a margin for a busy machine."""


async def infer_there(robot: Machine, gpu: Machine) -> None:
    """Run the scenario."""
    watcher = robot.talk("watcher", script=WATCHER)
    async with agent_of(robot) as here, agent_of(gpu) as there:
        for tool in ("start_robot", "start_perception", "start_control"):
            await here.do(tool)
        wait_until(lambda: watcher.report().get("positions"), 30.0, "the arm is measured")
        assert moved_rad(watcher) < STILL_RAD
        await there.do("start_inference", instruction="pick up the red cube")
        wait_until(lambda: moved_rad(watcher) > MOVED_RAD, 60.0, "the arm moves by the far policy")
        gpu.cut()
        cut_s = time.monotonic()
        wait_until(lambda: time.monotonic() > cut_s + HOLDS_S, 10.0, "time to hold")
        assert moved_rad(watcher) < STILL_RAD, "the arm holds without the other machine"
        gpu.plug()
        await here.do("emergency_stop")
        wait_until(lambda: moved_rad(watcher) < STILL_RAD, 20.0, "the arm is stopped")
        assert moved_rad(watcher, 3.0) < STILL_RAD, "the far module moves a stopped arm"
        await there.do("stop_inference")
        await here.do("stop_all")


def test_an_inference_module_moves_the_arm_of_another_machine(tmp_path: Path) -> None:
    with machines(tmp_path, "robot", "gpu") as made:
        pair(made["robot"], made["gpu"])
        anyio.run(infer_there, made["robot"], made["gpu"])
