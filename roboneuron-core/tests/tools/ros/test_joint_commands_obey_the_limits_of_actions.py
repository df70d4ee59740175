"""Zones, workspace and speed hold for joint commands as for actions, whatever tool sends them;
rates count messages.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from rn_testing.fakes import gantry_profile
from roboneuron.contract import RobotProfile
from roboneuron.direct_path.joint_messages import joint_commands
from roboneuron.tools.ros.exposed_types import is_joint_limited, sent_types

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]
JOINTS = ["slide_x", "slide_y", "slide_z", "yaw", "pitch", "roll", "finger"]
CONFIG = """
[robot]
name = "gantry"
[direct_path]
max_duration_s = 30
[[limits.zones]]
name = "person"
lower_m = [0.3, -0.2, -0.2]
upper_m = [0.4, 0.2, 0.2]
[limits]
min_height_m = -0.5
[[expose]]
name = "joint_trajectory"
kind = "publish"
topic = "joint_trajectory"
type = "trajectory_msgs/msg/JointTrajectory"
rate_hz = 50
[[expose]]
name = "joint_command"
kind = "publish"
topic = "joint_command"
type = "sensor_msgs/msg/JointState"
rate_hz = 50
"""


def to(at_s: float, **target: float) -> dict[str, Any]:
    return {
        "joint_names": list(target),
        "points": [{"positions": list(target.values()), "time_from_start": at_s}],
    }


@pytest.fixture
def arm(rover: Any) -> Any:
    """A gantry at (0.1, 0, 0) that is told where to go and stays."""
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectory

    rover._note(JointTrajectory, "/gantry/joint_trajectory", 10)
    rover._note(JointState, "/gantry/joint_command", 10)
    rover.publish_often(
        JointState, "/gantry/joint_states", JointState(name=JOINTS, position=[0.1] + [0.0] * 6)
    )
    return rover


def sent(arm: Any) -> list[Any]:
    return [*arm.on("/gantry/joint_trajectory"), *arm.on("/gantry/joint_command")]


THROUGH = {"slide_x": 0.7}
COMMAND = {"name": ["slide_x"], "position": [0.7]}
CALLS = [
    ("move_joints", {"positions": THROUGH, "duration_s": 8.0}),
    ("move_joints", {"positions": THROUGH}),
    ("publish_joint_trajectory", {"message": to(8.0, **THROUGH)}),
    (
        "publish_joint_trajectory_sequence",
        {"steps": [{"message": to(8.0, slide_x=0.2)}, {"message": to(8.0, **THROUGH)}]},
    ),
    ("publish_joint_command", {"message": COMMAND, "duration_s": 8.0}),
    (
        "publish_joint_command",
        {"message": {"name": ["slide_x"], "velocity": [0.1]}, "duration_s": 6.0},
    ),
    ("publish_joint_command_sequence", {"steps": [{"message": COMMAND, "duration_s": 8.0}]}),
]


def test_no_tool_drives_the_tcp_through_a_zone(run_arm: Callable[..., None], arm: Any) -> None:
    async def scenario(agent: Any) -> None:
        for tool, arguments in CALLS:
            code, text = await agent.fail(tool, **arguments)
            assert (code, "would enter 'person'" in text) == ("refused", True), (tool, text)
            dry = await agent.do(tool, **arguments, simulate=True)
            assert (dry["simulated"], dry["allowed"]) == (True, False)
            assert "would enter 'person'" in dry["reason"]
        assert sent(arm) == []

    run_arm(CONFIG, scenario)


def test_height_workspace_and_speed_hold_for_joint_commands(
    run_arm: Callable[..., None], arm: Any
) -> None:
    async def scenario(agent: Any) -> None:
        for target, duration_s, words in (
            ({"slide_z": -0.6}, 5.0, "height of -0.5"),
            ({"slide_y": 0.95}, 5.0, "outside the workspace"),
            ({"slide_y": 0.6}, 1.0, "TCP would move at 0.6 m/s, allowed is 0.5 m/s. Give it 1.2"),
        ):
            _, text = await agent.fail("publish_joint_trajectory", message=to(duration_s, **target))
            assert words in text
        easy = await agent.do("move_joints", positions={"slide_y": 0.6}, simulate=True)
        assert easy["allowed"]
        assert 1.2 <= easy["duration_s"] < 4.0
        assert sent(arm) == []

    run_arm(CONFIG, scenario)


def test_an_arm_whose_controller_is_not_installed_is_refused(
    run_arm: Callable[..., None], arm: Any
) -> None:
    async def scenario(agent: Any) -> None:
        _, text = await agent.fail("publish_joint_trajectory", message=to(5.0, slide_x=0.2))
        assert "cannot be checked" in text
        assert "'absent'" in text
        assert sent(arm) == []

    run_arm(CONFIG + '[control]\ncontroller = "absent"\n', scenario)


def test_a_sequence_counts_as_the_messages_that_it_sends(
    run_arm: Callable[..., None], arm: Any
) -> None:
    async def scenario(agent: Any) -> None:
        name = "publish_joint_command_sequence"
        step = {"message": {"name": ["slide_x"], "position": [0.1]}, "duration_s": 0.002}
        _, text = await agent.fail(name, steps=[step], times=500)
        assert "faster than its 50 per second" in text
        assert not (await agent.do(name, steps=[step], times=500, simulate=True))["allowed"]
        assert sent(arm) == []
        assert (await agent.do(name, steps=[step | {"duration_s": 0.02}], times=40))["sent"] == 40

    run_arm(CONFIG, scenario)


def test_a_finger_far_off_does_not_count_as_arrived(run_arm: Callable[..., None], arm: Any) -> None:
    """The finger is measured 9.8 mm from its target and stays there; the slide is 3 mm off."""

    async def scenario(agent: Any) -> None:
        for positions, off in (
            ({"finger": 0.0098}, "finger 0.0098"),
            ({"slide_x": 0.103}, "slide_x 0.0030"),
        ):
            code, text = await agent.fail("move_joints", positions=positions, duration_s=0.5)
            assert code == "wrong_state"
            assert off in text
        assert (await agent.do("move_joints", positions={"yaw": 0.008}, duration_s=0.5))[
            "error"
        ] < 0.01

    run_arm(CONFIG, scenario)


def test_tolerances_follow_the_type_of_the_joint() -> None:
    profile = gantry_profile()
    assert (
        profile.tolerance("slide_x"),
        profile.tolerance("yaw"),
        profile.tolerance("finger"),
    ) == (0.001, 0.01, 0.001)
    bare = RobotProfile(name="arm", gripper=replace(profile.gripper, open_position=0.8))  # type: ignore[type-var]
    assert bare.tolerance("finger") == 0.01
    small = RobotProfile(name="arm", gripper=replace(profile.gripper, open_position=0.02))  # type: ignore[type-var]
    assert small.tolerance("finger") == pytest.approx(0.0005)


def test_joint_commands_inside_goals_and_requests_are_found() -> None:
    from std_msgs.msg import Header
    from trajectory_msgs.msg import JointTrajectory

    class Goal:
        """As that of control_msgs/action/FollowJointTrajectory."""

        __module__ = "control_msgs.action._follow_joint_trajectory"

        def __init__(self) -> None:
            self.header = Header()
            self.trajectory = JointTrajectory(joint_names=["a"])
            self.others = [JointTrajectory(joint_names=["b"])]

        @classmethod
        def get_fields_and_field_types(cls) -> dict[str, str]:
            return {"header": "", "trajectory": "", "others": ""}

    assert [command.joint_names for command in joint_commands(Goal())] == [["a"], ["b"]]
    assert sent_types("publish", "geometry_msgs/msg/TwistStamped") >= {
        "std_msgs/msg/Header",
        "geometry_msgs/msg/Twist",
    }
    assert not is_joint_limited("action", "test_msgs/action/Fibonacci", gantry_profile())
    assert not is_joint_limited("read", "sensor_msgs/msg/JointState", gantry_profile())
    assert is_joint_limited("publish", "sensor_msgs/msg/JointState", gantry_profile())
