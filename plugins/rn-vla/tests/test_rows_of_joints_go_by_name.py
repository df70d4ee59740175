"""Rows of joint policies: their control space and their state."""

from __future__ import annotations

import numpy as np
import pytest

from rn_vla.joint_rows import PlatformJoints, declare_joints
from roboneuron import (
    ArmState,
    ConfigurationError,
    JointSample,
    Observation,
    Pose,
    RobotProfile,
    UngroundedError,
    UnsafeError,
)

ONE = PlatformJoints(kind="joint_velocity", joints=2, rate_hz=15.0, gripper="closed_fraction")
TWO = PlatformJoints(
    kind="joint_position",
    joints=2,
    rate_hz=25.0,
    gripper="open_fraction",
    arms=("left", "right"),
)
NAMES = ("hip", "knee", "waist", "neck")
POSE = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))


def seen(names: tuple[str, ...] = NAMES, **openings: float | None) -> Observation:
    """Observation in which joint number i of `NAMES` is at i, with the given gripper openings."""
    position = np.array([float(NAMES.index(name)) for name in names])
    arms = {arm: ArmState(ee_pose=POSE, gripper_open=open_) for arm, open_ in openings.items()}
    return Observation(
        frames={},
        instruction="go",
        joints=JointSample(names=names, position=position),
        gripper_open=0.25,
        arms=arms,
    )


def test_channels_name_joint_arm_and_unit() -> None:
    assert ONE.space(("a", "b")).label == "joint_velocity@15:a,b,gripper_open"
    keys = ("left/hip", "left/knee", "left/gripper_open")
    assert TWO.space(NAMES).keys == (*keys, "right/waist", "right/neck", "right/gripper_open")
    assert [channel.unit for channel in TWO.space(NAMES).channels[:3]] == ["rad", "rad", "opening"]


@pytest.mark.parametrize("order", [NAMES, NAMES[::-1]])
def test_joints_are_taken_by_name_and_grippers_by_arm(order: tuple[str, ...]) -> None:
    state = TWO.read_state(seen(order, right=0.9, left=0.1), NAMES)
    assert state.tolist() == [0.0, 1.0, 0.1, 2.0, 3.0, 0.9]
    assert ONE.read_state(seen(order), ("neck", "hip")).tolist() == [3.0, 0.0, 0.75]


@pytest.mark.parametrize(
    ("observation", "words"),
    [
        (seen(("hip", "waist"), left=0.1, right=0.2), "needs knee, neck; the joints that are"),
        (seen(left=0.1), "opening of arm 'right'"),
        (seen(left=0.1, right=None), "opening of arm 'right'"),
        (Observation(frames={}, instruction="go"), "measured are none"),
    ],
)
def test_what_is_not_measured_is_named(observation: Observation, words: str) -> None:
    with pytest.raises(UngroundedError, match=words):
        TWO.read_state(observation, NAMES)


def test_a_state_that_is_no_number_is_refused() -> None:
    with pytest.raises(UnsafeError, match="non-finite"):
        TWO.read_state(seen(left=float("nan"), right=0.5), NAMES)


def test_openings_are_cut_and_counted_from_closed() -> None:
    rows = ONE.to_contract(np.array([[5.0, -5.0, 1.25], [0.0, 0.0, 0.25]]))
    assert rows.tolist() == [[5.0, -5.0, 0.0], [0.0, 0.0, 0.75]]


@pytest.mark.parametrize("names", [("a",), ("a", "a"), ("a", "b", "c")])
def test_another_number_of_joints_is_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(ConfigurationError, match="the policy moves 2, each of an arm's once"):
        ONE.space(names)


def test_the_robots_joints_are_offered_where_the_option_is_missing_or_wrong() -> None:
    robot = RobotProfile(name="legs", arm_joints=("hip", "knee"))
    for joints, words in (
        (None, "needs the option 'joints'"),
        (["hip", "toe"], "names toe, which"),
    ):
        with pytest.raises(ConfigurationError, match=words) as refusal:
            declare_joints(ONE, {"joints": joints}, robot, policy="It")
        assert 'joints = ["hip", "knee"]' in refusal.value.hint
    assert declare_joints(ONE, {"joints": ["knee", "hip"]}, robot, policy="It").keys[0] == "knee"
