"""Control spaces: their labels, the checks of a row, and the spaces that a robot executes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from roboneuron.contract import (
    ACTION_FIELDS,
    ACTION_LABEL,
    EE_DELTA,
    GRIPPER,
    SPACE_KINDS,
    ActionChunk,
    Channel,
    ControlSpace,
    GripperProfile,
    RobotProfile,
    channel_keys,
    robot_space,
)
from roboneuron.errors import InvalidInputError, UnsafeError

ARM = ("swing", "lift")
URDF = """
<robot name="hoist">
  <link name="base"/><link name="boom"/><link name="hook"/>
  <joint name="swing" type="revolute"><parent link="base"/><child link="boom"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="lift" type="prismatic"><parent link="boom"/><child link="hook"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
</robot>"""
HOIST = RobotProfile(
    name="hoist",
    urdf=URDF,
    base_link="base",
    tcp_link="hook",
    arm_joints=ARM,
    gripper=GripperProfile(joint="jaw", closed_position=0.0, open_position=0.1),
)
LABELS = {
    "ee_delta": ACTION_LABEL,
    "ee_pose": "ee_pose:x,y,z,qx,qy,qz,qw,gripper_open",
    "joint_position": "joint_position:swing,lift,gripper_open",
    "joint_velocity": "joint_velocity:swing,lift,gripper_open",
    "joint_delta": "joint_delta:swing,lift,gripper_open",
}


def test_there_is_a_label_for_every_kind() -> None:
    assert {kind: robot_space(kind, HOIST).label for kind in SPACE_KINDS} == LABELS
    assert robot_space("ee_delta", HOIST) is EE_DELTA


@pytest.mark.parametrize("kind", [kind for kind in SPACE_KINDS if kind != "ee_delta"])
@pytest.mark.parametrize("rate_hz", [0.0, 0.5, 12.5, 15.0, 1000.0])
def test_a_label_with_a_rate_names_its_channels(kind: str, rate_hz: float) -> None:
    space = robot_space(kind, HOIST, rate_hz)
    assert ("@" in space.label) == (rate_hz > 0.0)
    assert channel_keys(space.label) == space.keys


def test_the_default_label_names_the_fields_of_an_action() -> None:
    assert channel_keys(ACTION_LABEL) == ACTION_FIELDS == EE_DELTA.keys


def test_units_are_those_of_the_joints() -> None:
    units = {
        kind: [(one.unit, one.frame) for one in robot_space(kind, HOIST).channels]
        for kind in SPACE_KINDS
    }
    opening = ("opening", "")
    assert units["joint_position"] == [("rad", ""), ("m", ""), opening]
    assert units["joint_delta"] == units["joint_position"]
    assert units["joint_velocity"] == [("rad/s", ""), ("m/s", ""), opening]
    assert units["ee_pose"] == [("m", "base")] * 3 + [("1", "base")] * 4 + [opening]
    assert units["ee_delta"] == [("m", "base")] * 3 + [("rad", "base")] * 3 + [opening]


def test_a_robot_without_a_gripper_has_no_channel_for_it() -> None:
    assert robot_space("joint_velocity", replace(HOIST, gripper=None)).keys == ARM


def test_a_robot_without_an_arm_executes_no_other_space() -> None:
    base = replace(HOIST, arm_joints=())
    with pytest.raises(InvalidInputError, match="'hoist' has no arm that 'ee_pose' could move"):
        robot_space("ee_pose", base)


def test_channels_of_an_arm_are_named_after_it() -> None:
    channels = [
        Channel(name=name, unit=unit, arm=arm)
        for arm in ("left", "right")
        for name, unit in (("swing", "rad"), (GRIPPER, "opening"))
    ]
    space = ControlSpace(kind="joint_position", channels=tuple(channels))
    assert space.keys == (
        "left/swing",
        "left/gripper_open",
        "right/swing",
        "right/gripper_open",
    )
    with pytest.raises(InvalidInputError, match=r"right/gripper_open is 1.2"):
        space.check([0.0, 1.0, 0.0, 1.2])


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"kind": "torque"}, "'torque' is no control space; there are: ee_delta, ee_pose"),
        ({"rate_hz": -1.0}, "A rate of -1.0 Hz is none"),
        ({"rate_hz": float("nan")}, "A rate of nan Hz is none"),
        ({"rate_hz": 1001.0}, "A rate of 1001.0 Hz is none"),
        ({"channels": ()}, "are not distinct"),
        ({"channels": (Channel(name="a", unit="rad"),) * 2}, "are not distinct"),
    ],
)
def test_a_space_that_is_none_is_refused(changes: dict[str, object], match: str) -> None:
    with pytest.raises(InvalidInputError, match=match):
        replace(robot_space("joint_position", HOIST), **changes)  # type: ignore[arg-type]


def test_seven_other_numbers_do_not_bear_the_label_of_an_action() -> None:
    turned = ControlSpace(kind="ee_delta", channels=EE_DELTA.channels[::-1])
    assert turned.label == "ee_delta:" + ",".join(reversed(ACTION_FIELDS))


# Rows


@pytest.mark.parametrize("kind", SPACE_KINDS)
def test_a_good_row_comes_back_as_it_is(kind: str) -> None:
    space = robot_space(kind, HOIST)
    row = np.zeros(space.size)
    row[[i for part in space.quaternions for i in part[-1:]]] = 1.0
    row[-1] = 1.0
    assert space.check(row.tolist()).tolist() == row.tolist()


@pytest.mark.parametrize("kind", SPACE_KINDS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_none_is_named(kind: str, value: float) -> None:
    space = robot_space(kind, HOIST)
    for place, key in enumerate(space.keys):
        row = np.zeros(space.size)
        row[place] = value
        with pytest.raises(UnsafeError, match=f"non-finite value at {key} "):
            space.check(row)


@pytest.mark.parametrize("kind", SPACE_KINDS)
@pytest.mark.parametrize("opening", [1.2, -0.1])
def test_an_opening_beyond_its_ends_is_refused(kind: str, opening: float) -> None:
    space = robot_space(kind, HOIST)
    row = np.zeros(space.size)
    row[-1] = opening
    with pytest.raises(InvalidInputError, match=f"gripper_open is {opening:g}"):
        space.check(row)


@pytest.mark.parametrize("kind", SPACE_KINDS)
@pytest.mark.parametrize("more", [-1, 1, 7])
def test_a_row_of_another_size_is_refused(kind: str, more: int) -> None:
    space = robot_space(kind, HOIST)
    with pytest.raises(InvalidInputError, match=rf"expected \({space.size},\)"):
        space.check(np.zeros(space.size + more))


@pytest.mark.parametrize("length", [0.0, 0.8, 1.2, 1e300])
def test_a_quaternion_of_another_length_than_one_is_refused(length: float) -> None:
    with pytest.raises(InvalidInputError, match="qx, qy, qz, qw have the length"):
        robot_space("ee_pose", HOIST).check([0.3, 0.0, 0.4, 0.0, 0.0, 0.0, length, 1.0])


def test_a_quaternion_is_found_by_its_names() -> None:
    names = ("qw", "qx", "qy", "qz", GRIPPER, "x", "y", "z")
    units = {**dict.fromkeys(names, "1"), **dict.fromkeys("xyz", "m"), GRIPPER: "opening"}
    channels = tuple(Channel(name=name, unit=units[name], frame="base") for name in names)
    space = ControlSpace(kind="ee_pose", channels=channels)
    assert space.quaternions == ([1, 2, 3, 0],)
    space.check([1.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.0, 0.4])
    with pytest.raises(InvalidInputError, match="qx, qy, qz, qw have the length 0"):
        space.check([0.0, 0.0, 0.0, 0.0, 1.0, 0.3, 0.0, 0.4])


def test_each_arm_has_a_quaternion_of_its_own() -> None:
    keys = [(arm, f"q{axis}") for arm in ("left", "right") for axis in "xyzw"]
    channels = tuple(Channel(name=name, unit="1", frame="base", arm=arm) for arm, name in keys)
    space = ControlSpace(kind="ee_pose", channels=channels)
    assert space.quaternions == ([0, 1, 2, 3], [4, 5, 6, 7])


def test_a_chunk_holds_rows_of_its_space_alone() -> None:
    space = robot_space("joint_position", HOIST)
    chunk = ActionChunk(actions=np.array([[0.1, 0.2, 1.0]]), step_s=0.1, space=space)
    assert chunk.space is space
    with pytest.raises(InvalidInputError, match=r"expected \(H >= 1, 3\)"):
        ActionChunk(actions=np.zeros((1, 7)), step_s=0.1, space=space)
    with pytest.raises(InvalidInputError, match=r"gripper_open is 1.2"):
        ActionChunk(actions=np.array([[0.0, 0.0, 1.2]]), step_s=0.1, space=space)
