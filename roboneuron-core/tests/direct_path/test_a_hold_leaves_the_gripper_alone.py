"""What ends a joint motion holds the arm, and never tells fingers to be where an object blocks
them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from roboneuron.contract import GripperProfile, JointSample, RobotProfile
from roboneuron.direct_path.delivery import _hold

PROFILE = RobotProfile(
    name="arm", gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)
)
MEASURED = JointSample(names=("j1", "finger"), position=np.array([0.3, 0.02]))


def trajectory(*names: str) -> Any:
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    return JointTrajectory(
        joint_names=list(names), points=[JointTrajectoryPoint(positions=[0.0] * len(names))]
    )


def test_a_trajectory_of_arm_and_fingers_ends_in_a_hold_of_the_arm() -> None:
    held = _hold(trajectory("j1", "finger"), MEASURED, PROFILE)
    assert (held.joint_names, list(held.points[0].positions)) == (["j1"], [0.3])


def test_fingers_alone_go_on_to_where_they_were_sent() -> None:
    assert _hold(trajectory("finger"), MEASURED, PROFILE) is None


@pytest.mark.parametrize("profile", [None, RobotProfile(name="arm")])
def test_every_joint_of_a_robot_without_a_gripper_is_held(profile: RobotProfile | None) -> None:
    assert _hold(trajectory("j1", "finger"), MEASURED, profile).joint_names == ["j1", "finger"]


def test_joint_states_are_held_likewise() -> None:
    from sensor_msgs.msg import JointState

    held = _hold(JointState(name=["j1", "finger"], position=[0.0, 0.0]), MEASURED, PROFILE)
    assert (held.name, list(held.position)) == (["j1"], [0.3])
