"""An agent drives a simulated base with nav2's action `NavigateToPose`, through the tool generated
from its definition: to a goal, not into a zone, and to rest after a cancellation or failure.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from rn_standard.demo.agent import module_status
from rn_testing.agent import Agent, client_of
from rn_testing.waiting import wait_for_line

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
EXAMPLES = Path(__file__).parents[1] / "examples"
CONFIG = """
[robot]
name = "diffdrive"
[supervisor]
state_directory = "{state}"
[[expose]]
name = "drive_to"
kind = "action"
topic = "navigate_to_pose"
type = "nav2_msgs/action/NavigateToPose"
bounds = {{ "pose.pose.position.x" = [-2, 3], "pose.pose.position.y" = [-2, 2] }}
frame = "map"
[[expose.zones]]
name = "stairs"
lower_m = [0.6, -0.4, -1]
upper_m = [1.0, 0.4, 1]
"""


def goal(x_m: float, y_m: float, frame: str = "map", **more: Any) -> dict[str, Any]:
    """A goal with the heading along x."""
    pose = {"position": {"x": x_m, "y": y_m}, "orientation": {"w": 1.0}}
    return {"pose": {"header": {"frame_id": frame}, "pose": pose}, **more}


class Bench:
    """The environment of a server and of the navigator."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self._folder, self._environment = folder, environment
        self._processes: list[subprocess.Popen[str]] = []

    def navigator(self, *options: str) -> None:
        """Start the stand-in; return when it offers its action."""
        command = [sys.executable, str(EXAMPLES / "nav_standin.py"), "--namespace", "diffdrive"]
        process = subprocess.Popen(
            [*command, *options], env=self._environment, stdout=subprocess.PIPE, text=True
        )
        self._processes.append(process)
        wait_for_line(process.stdout, "navigate_to_pose is offered")

    @asynccontextmanager
    async def agent(self) -> AsyncIterator[BaseAgent]:
        """A client of a server with a started base."""
        config = self._folder / "roboneuron.toml"
        config.write_text(CONFIG.format(state=self._folder / "state"))
        async with client_of(config, self._environment) as client:
            made = BaseAgent(client)
            assert (await made.call("start_robot"))[0]
            yield made

    def close(self) -> None:
        for process in self._processes:
            process.terminate()
            process.communicate(timeout=30)


class BaseAgent(Agent):
    """Drives a base."""

    async def drive(self, to: dict[str, Any], **more: Any) -> tuple[bool, dict[str, Any], str]:
        """Send a goal; the first one waits for the discovery of the action server."""
        return await self.call("send_drive_to_goal", goal=to, server_timeout_s=30.0, **more)

    async def place(self) -> tuple[float, float]:
        """Pose of the base from the simulator, at rest."""
        before = (math.inf, math.inf)
        while True:
            _, status, _ = await self.call("get_status")
            pose = json.loads(module_status(status, "robot")["detail"]["true_pose"])
            now = pose["x_m"], pose["y_m"]
            if math.dist(before, now) < 1e-3:
                return now
            before = now
            await anyio.sleep(0.5)


@pytest.fixture
def bench(tmp_path: Path, learnt_environment: dict[str, str]) -> Iterator[Bench]:
    made = Bench(tmp_path, {**learnt_environment, "ROBONEURON_SIMULATOR_TRUTH": "on"})
    yield made
    made.close()


def test_a_base_drives_to_a_goal_and_into_no_zone(bench: Bench) -> None:
    bench.navigator()

    async def scenario() -> None:
        async with bench.agent() as agent:
            for to, told in (
                (goal(0.8, 0.0), "is in the zone 'stairs'"),
                (goal(0.5, 0.5, frame="odom"), "expected 'map'"),
                (goal(0.5, 9.0), "pose.pose.position.y is 9"),
            ):
                succeeded, _, text = await agent.drive(to)
                assert not succeeded
                assert told in text
            assert math.dist(await agent.place(), (0.0, 0.0)) < 0.01, "a refused goal moved it"
            for _ in range(3):  # a busy machine keeps the odometry back, and the navigator gives up
                succeeded, answer, text = await agent.drive(goal(0.4, 0.6))
                if succeeded or "TF_ERROR" not in text:
                    break
            assert succeeded, text
            assert answer["status"] == "succeeded"
            assert answer["result"]["error_code"] in (0, "NONE")
            assert any("distance_remaining" in told for told in agent.told)
            assert math.dist(await agent.place(), (0.4, 0.6)) < 0.08
            # straight across the zone, which is not on the navigator's map
            succeeded, _, text = await agent.drive(goal(1.3, -0.5))
            assert not succeeded
            assert "has come into the zone 'stairs'" in text
            x_m, _ = await agent.place()
            assert x_m < 1.0, "it went on through the zone"

    anyio.run(scenario)


@pytest.mark.exhaustive
def test_goals_that_end_otherwise_leave_a_base_at_rest(bench: Bench) -> None:
    bench.navigator("--blocked", "2", "1", "3", "2", "--patience", "0.5")

    async def scenario() -> None:
        async with bench.agent() as agent:
            succeeded, _, text = await agent.drive(goal(-2.0, 0.0), timeout_s=2.0)
            assert not succeeded
            assert "did not end within 2 s" in text
            x_m, _ = await agent.place()
            assert -1.5 < x_m < 0.01, "cancelled, it stands on its way"
            succeeded, _, text = await agent.drive(goal(2.5, 1.5))
            assert not succeeded
            assert "aborted" in text
            assert "no progress" in text
            tree = {"behavior_tree": "/nowhere.xml"}
            succeeded, _, text = await agent.drive({**goal(0.0, 0.0), **tree})
            assert not succeeded
            assert "FAILED_TO_LOAD_BEHAVIOR_TREE" in text or "9001" in text
            held = await agent.place()
            await agent.call("emergency_stop")
            succeeded, _, text = await agent.drive(goal(0.0, 1.0))
            assert not succeeded
            assert math.dist(await agent.place(), held) < 0.01

    anyio.run(scenario)


@pytest.mark.exhaustive
def test_an_inactive_navigator_rejects(bench: Bench) -> None:
    bench.navigator("--inactive")

    async def scenario() -> None:
        async with bench.agent() as agent:
            succeeded, _, text = await agent.drive(goal(0.4, 0.6))
            assert not succeeded
            assert "rejected the goal" in text

    anyio.run(scenario)
