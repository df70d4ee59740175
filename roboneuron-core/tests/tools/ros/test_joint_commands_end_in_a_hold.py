"""Trajectories and joint commands last as long as they take, follow each other within the limits,
and can be ended.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import anyio
import pytest

from roboneuron.server.app import Application

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]
CONFIG = """
[robot]
name = "gantry"
[direct_path]
max_duration_s = 20
[limits]
max_speed_m_s = 3.0
[[expose]]
name = "joint_trajectory"
kind = "publish"
topic = "joint_trajectory"
type = "trajectory_msgs/msg/JointTrajectory"
[[expose]]
name = "joint_command"
kind = "publish"
topic = "joint_command"
type = "sensor_msgs/msg/JointState"
"""
JOINTS = ["slide_x", "slide_y", "slide_z", "yaw", "pitch", "roll"]
TRAJECTORIES, COMMANDS = "/gantry/joint_trajectory", "/gantry/joint_command"
Scenario = Callable[[Any], Any]


def to(position: float, at_s: float) -> dict[str, Any]:
    """slide_x, measured at 0.1, to a position; its limits are -1 .. 1 and 1 per second."""
    return {
        "joint_names": ["slide_x"],
        "points": [{"positions": [position], "time_from_start": at_s}],
    }


@pytest.fixture
def arm(rover: Any) -> Any:
    """A node that says where the joints are and notes what they are told."""
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    rover._note(JointTrajectory, TRAJECTORIES, 10)
    rover._note(JointState, COMMANDS, 10)
    rover.publish_often(
        JointState, "/gantry/joint_states", JointState(name=JOINTS, position=[0.1] + [0.0] * 5)
    )
    return rover


@pytest.fixture
def ask_arm(make_application: Callable[..., Application], arm: Any) -> Callable[[Scenario], None]:
    """Run a scenario with a client of a server that exposes the arm's commands."""
    from mcp import Client

    application = make_application(CONFIG)

    class Asking:
        """What the scenarios do."""

        def __init__(self, client: Client) -> None:
            self.client = client

        async def do(self, name: str, **arguments: Any) -> Any:
            answer = await self.client.call_tool(name, arguments)
            assert not answer.is_error, answer.content
            return answer.structured_content

        async def fail(self, name: str, **arguments: Any) -> str:
            answer = await self.client.call_tool(name, arguments)
            assert answer.is_error, answer.structured_content
            return answer.content[0].text  # type: ignore[union-attr]

    async def connect(scenario: Scenario) -> None:
        async with Client(application.server) as client:
            await scenario(Asking(client))

    return lambda scenario: anyio.run(connect, scenario)


async def count(arm: Any, topic: str, number: int) -> list[Any]:
    with anyio.fail_after(10):
        while len(arm.on(topic)) < number:
            await anyio.sleep(0.005)
    return arm.on(topic)  # type: ignore[no-any-return]


def test_a_trajectory_lasts_as_long_as_its_points_say(ask_arm: Any, arm: Any) -> None:
    async def scenario(agent: Any) -> None:
        began_s = time.monotonic()
        result = await agent.do("publish_joint_trajectory", message=to(0.3, 0.5))
        assert time.monotonic() - began_s >= 0.5
        assert (result["sent"], result["stopped"]) == (1, False)
        assert "would last 30 s" in await agent.fail(
            "publish_joint_trajectory", message=to(0.3, 30)
        )
        assert len(await count(arm, TRAJECTORIES, 1)) == 1

    ask_arm(scenario)


@pytest.mark.parametrize("cause", ["cancel", "stop"])
def test_a_trajectory_that_may_not_go_on_ends_where_the_joints_are(
    ask_arm: Any, arm: Any, cause: str
) -> None:
    async def scenario(agent: Any) -> None:
        texts: list[str] = []

        async def move() -> None:
            texts.append(await agent.fail("publish_joint_trajectory", message=to(0.9, 10)))

        with anyio.CancelScope() as scope:
            async with anyio.create_task_group() as group:
                group.start_soon(move)
                await count(arm, TRAJECTORIES, 1)
                if cause == "cancel":
                    scope.cancel()
                else:
                    await agent.do("emergency_stop")
        hold = (await count(arm, TRAJECTORIES, 2))[1]
        assert (hold.joint_names, list(hold.points[0].positions)) == (["slide_x"], [0.1])
        if cause == "stop":
            assert "the joints were told to hold: The emergency stop is latched" in texts[0]

    ask_arm(scenario)


def test_each_step_of_a_sequence_begins_where_the_one_before_ends(ask_arm: Any, arm: Any) -> None:
    async def scenario(agent: Any) -> None:
        name = "publish_joint_trajectory_sequence"
        far = [{"message": to(0.5, 1)}, {"message": to(-0.6, 1)}]  # 0.4 and 1.1 in 1 s
        assert "steps[1]: slide_x would move at 1.1 per second" in await agent.fail(name, steps=far)
        again = [{"message": to(0.85, 1.2)}]  # from 0.1 within the limits, from 0.85 as well
        assert (await agent.do(name, steps=again, times=2, simulate=True))["allowed"]
        short = [{"message": to(0.2, 1), "duration_s": 0.5}]
        assert "takes 1 s, its step only 0.5 s" in await agent.fail(name, steps=short)
        assert not arm.on(TRAJECTORIES)
        result = await agent.do(
            name, steps=[{"message": to(0.13, 0.2)}, {"message": to(0.1, 0.2), "duration_s": 0.3}]
        )
        assert (result["sent"], result["stopped"]) == (2, False)
        assert result["duration_s"] >= 0.5

    ask_arm(scenario)


def test_positions_are_checked_for_pace_and_velocities_end_in_zero(ask_arm: Any, arm: Any) -> None:
    async def scenario(agent: Any) -> None:
        name = "publish_joint_command"
        jump = {"name": ["slide_x"], "position": [0.9]}
        assert "slide_x would move at 1.6 per second" in await agent.fail(
            name, message=jump, duration_s=0.5
        )
        away = {"name": ["slide_x"], "velocity": [0.5]}
        assert "slide_x would be at 1.1 after 2 s" in await agent.fail(
            name, message=away, duration_s=2
        )
        steps = [{"message": away, "duration_s": 1.5}, {"message": away, "duration_s": 0.5}]
        assert "steps[1]: slide_x would be at 1.1" in await agent.fail(
            f"{name}_sequence", steps=steps
        )
        assert not arm.on(COMMANDS)
        assert not (
            await agent.do(name, message={"name": ["slide_x"], "position": [0.11]}, duration_s=0.1)
        )["stopped"]
        assert (await agent.do(name, message=away, duration_s=0.2))["stopped"]
        told = await count(arm, COMMANDS, 3)
        assert [list(m.velocity) for m in told] == [[], [0.5], [0.0]]

    ask_arm(scenario)
