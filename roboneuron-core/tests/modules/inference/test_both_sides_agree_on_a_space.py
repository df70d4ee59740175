"""Agreement of a backend's space with a robot's, by names, units, frames and rate; and what becomes
of the backend's chunks.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import (
    EE_DELTA,
    GRIPPER,
    SPACE_KINDS,
    ActionChunk,
    ArmProfile,
    Channel,
    ControlSpace,
    GripperProfile,
    JointSample,
    RobotProfile,
    robot_space,
)
from roboneuron.errors import InvalidInputError, PlanningError
from roboneuron.modules.inference.agreement import SpaceAgreement, agree

ARM = ("a", "b", "c")
ROBOT = RobotProfile(
    name="trio",
    base_link="base",
    arm_joints=ARM,
    gripper=GripperProfile(joint="jaw", closed_position=0.0, open_position=0.1),
)


def agreed(declared: ControlSpace, kinds: Sequence[str] = SPACE_KINDS, **more: Any) -> Any:
    return agree(declared, ROBOT, kinds, backend="policy", controller="ik", **more)


def joint_space(kind: str, names: Sequence[str], rate_hz: float = 0.0, **odd: str) -> ControlSpace:
    """A space of these channels in this order; `odd`: other units by name."""
    unit = "rad/s" if kind == "joint_velocity" else "rad"
    channels = [
        Channel(name=name, unit=odd.get(name, "opening" if name == GRIPPER else unit))
        for name in names
    ]
    return ControlSpace(kind=kind, channels=tuple(channels), rate_hz=rate_hz)


def chunk_of(space: ControlSpace, *rows: Sequence[float], step_s: float = 0.1) -> ActionChunk:
    return ActionChunk(actions=np.array(rows), step_s=step_s, space=space, note="going on")


@pytest.mark.parametrize("kind", SPACE_KINDS)
def test_the_robots_own_space_is_executed_as_it_is(kind: str) -> None:
    declared = robot_space(kind, ROBOT, 0.0 if kind == "ee_delta" else 10.0)
    agreement = agreed(declared)
    assert agreement.columns == tuple(range(declared.size))
    executed = "joint_position" if kind == "joint_delta" else kind
    assert agreement.executed == robot_space(executed, ROBOT, declared.rate_hz)


def test_a_chunk_of_the_default_space_is_not_touched() -> None:
    chunk = ActionChunk(actions=np.zeros((3, 7)), step_s=0.1)
    assert agreed(EE_DELTA).convert(chunk, None) is chunk


def test_channels_in_another_order_are_put_into_the_robots() -> None:
    declared = joint_space("joint_position", (GRIPPER, "c", "a", "b"))
    agreement = agreed(declared)
    chunk = agreement.convert(chunk_of(declared, [1.0, 0.3, 0.1, 0.2], [0.0, 3, 1, 2]), None)
    assert chunk.space == robot_space("joint_position", ROBOT)
    assert chunk.actions.tolist() == [[0.1, 0.2, 0.3, 1.0], [1, 2, 3, 0]]
    assert (chunk.note, chunk.step_s) == ("going on", 0.1)


def test_a_quaternion_that_begins_with_w_is_put_into_the_robots_order() -> None:
    own = robot_space("ee_pose", ROBOT)
    order = [6, 3, 4, 5, 0, 1, 2, 7]
    declared = replace(own, channels=tuple(own.channels[i] for i in order))
    row = [0.6, 0.0, 0.8, 0.0, 0.3, 0.1, 0.4, 1.0]
    chunk = agreed(declared).convert(chunk_of(declared, row), None)
    assert chunk.actions.tolist() == [[0.3, 0.1, 0.4, 0.0, 0.8, 0.0, 0.6, 1.0]]


def test_an_action_in_another_order_is_put_into_that_of_the_contract() -> None:
    declared = ControlSpace(kind="ee_delta", channels=EE_DELTA.channels[::-1])
    agreement = agreed(declared)
    chunk = agreement.convert(chunk_of(declared, [1.0, 6, 5, 4, 3, 2, 1]), None)
    assert chunk.space is EE_DELTA
    assert chunk.actions.tolist() == [[1, 2, 3, 4, 5, 6, 1.0]]
    with pytest.raises(InvalidInputError, match="The backend answered in ee_delta"):
        agreement.convert(ActionChunk(actions=np.zeros((1, 7)), step_s=0.1), None)


def test_an_action_in_another_order_than_declared_is_refused() -> None:
    turned = ControlSpace(kind="ee_delta", channels=EE_DELTA.channels[::-1])
    with pytest.raises(InvalidInputError, match="The backend answered in ee_delta"):
        agreed(EE_DELTA).convert(chunk_of(turned, [1.0, 0, 0, 0, 0, 0, 0]), None)


@pytest.mark.parametrize(
    ("declared", "problems"),
    [
        (joint_space("joint_position", ("a", "b", GRIPPER)), "the backend lacks c."),
        (joint_space("joint_position", (*ARM, "d", GRIPPER)), "the robot lacks d."),
        (
            joint_space("joint_position", ("a", "b", "hip", GRIPPER)),
            "the backend lacks c; the robot lacks hip.",
        ),
        (
            joint_space("joint_position", (*ARM, GRIPPER), b="deg"),
            "unit of b: 'deg', expected 'rad'.",
        ),
        (
            joint_space("joint_velocity", (*ARM, GRIPPER), rate_hz=10.0, c="rad"),
            "unit of c: 'rad', expected 'rad/s'.",
        ),
        (joint_space("joint_delta", (*ARM, GRIPPER), a="m"), "unit of a: 'm', expected 'rad'."),
        (
            replace(
                robot_space("ee_pose", ROBOT),
                channels=tuple(
                    replace(one, frame="camera") if one.name == "x" else one
                    for one in robot_space("ee_pose", ROBOT).channels
                ),
            ),
            "frame of x: 'camera', expected 'base'.",
        ),
        (
            joint_space("joint_velocity", (*ARM, GRIPPER)),
            "the backend does not say how many rows a second it yields.",
        ),
    ],
)
def test_every_difference_is_told(declared: ControlSpace, problems: str) -> None:
    with pytest.raises(PlanningError) as refusal:
        agreed(declared)
    message = refusal.value.message
    assert message.startswith(f"Backend 'policy' yields {declared.kind} (")
    assert "; robot 'trio' executes " in message
    assert message.endswith(f": {problems}")
    assert "Name the robot's joints" in refusal.value.hint


def test_channels_of_an_arm_that_the_robot_has_not_are_told() -> None:
    channels = tuple(
        Channel(name=name, unit="opening" if name == GRIPPER else "rad", arm=arm)
        for arm in ("left", "right")
        for name in (*ARM, GRIPPER)
    )
    with pytest.raises(PlanningError, match="the robot lacks left/a, left/b") as refusal:
        agreed(ControlSpace(kind="joint_position", channels=channels))
    assert "the backend lacks a, b, c, gripper_open" in refusal.value.message


@pytest.mark.parametrize("kind", ["joint_position", "joint_velocity", "ee_pose", "joint_delta"])
def test_a_space_that_the_controller_does_not_execute_is_refused(kind: str) -> None:
    executed = "joint_position" if kind == "joint_delta" else kind
    with pytest.raises(PlanningError, match="controller 'ik' executes ee_delta") as refusal:
        agreed(robot_space(kind, ROBOT), ["ee_delta"])
    assert refusal.value.hint == f"Choose a controller that executes {executed!r}."


def test_deltas_are_told_from_positions() -> None:
    """Both have the same names and units: the message says which are relative."""
    with pytest.raises(PlanningError, match="relative to the measured joints"):
        agreed(robot_space("joint_delta", ROBOT), ["ee_delta", "joint_velocity"])
    positions = agreed(robot_space("joint_position", ROBOT))
    deltas = chunk_of(robot_space("joint_delta", ROBOT), [0.0, 0, 0, 1])
    with pytest.raises(InvalidInputError, match=r"answered in joint_delta .*declares joint_pos"):
        positions.convert(deltas, None)


def test_a_period_longer_than_control_waits_is_refused() -> None:
    agreed(robot_space("joint_velocity", ROBOT, 5.0), longest_s=0.2)
    with pytest.raises(PlanningError, match=r"2 rows a second are too few: control holds 0.2 s"):
        agreed(robot_space("joint_velocity", ROBOT, 2.0), longest_s=0.2)


def test_a_robot_without_an_arm_is_named() -> None:
    with pytest.raises(PlanningError, match="'policy' does not fit: Robot 'trio' has no arm"):
        agree(
            robot_space("joint_position", ROBOT),
            replace(ROBOT, arm_joints=()),
            SPACE_KINDS,
            backend="policy",
            controller="ik",
        )


# Chunks


@pytest.fixture
def deltas() -> SpaceAgreement:
    agreement: SpaceAgreement = agreed(joint_space("joint_delta", (GRIPPER, "c", "b", "a")))
    return agreement


def test_deltas_are_added_to_the_measured_joints_by_name(deltas: SpaceAgreement) -> None:
    measured = JointSample(
        names=("jaw", "b", "a", "elsewhere", "c"), position=np.array([0.05, 2.0, 1.0, 9.0, 3.0])
    )
    chunk = deltas.convert(chunk_of(deltas.declared, [0.5, 0.3, 0.2, 0.1]), measured)
    assert chunk.space.kind == "joint_position"
    assert chunk.actions[0] == pytest.approx([1.1, 2.2, 3.3, 0.5])


def test_all_rows_are_relative_to_the_same_joints(deltas: SpaceAgreement) -> None:
    measured = JointSample(names=ARM, position=np.array([1.0, 2.0, 3.0]))
    rows = [[1.0, 0.3, 0.2, 0.1], [1.0, 0.6, 0.4, 0.2]]
    chunk = deltas.convert(chunk_of(deltas.declared, *rows), measured)
    assert chunk.actions[1] == pytest.approx([1.2, 2.4, 3.6, 1.0])


@pytest.mark.parametrize("names", [None, (), ("a", "c"), ("jaw", "a", "c")])
def test_deltas_without_the_joints_are_refused(
    deltas: SpaceAgreement, names: tuple[str, ...] | None
) -> None:
    measured = None if names is None else JointSample(names=names, position=np.zeros(len(names)))
    with pytest.raises(InvalidInputError, match=r"The measured joints lack .*b"):
        deltas.convert(chunk_of(deltas.declared, [1.0, 0, 0, 0]), measured)


@pytest.mark.parametrize(
    "other",
    [
        EE_DELTA,
        robot_space("joint_velocity", ROBOT, 10.0),
        robot_space("joint_position", ROBOT, 5.0),
        robot_space("joint_position", ROBOT),
        joint_space("joint_position", ("b", "a", "c", GRIPPER), rate_hz=10.0),
        joint_space("joint_position", (*ARM, GRIPPER), rate_hz=10.0, a="deg"),
    ],
)
def test_a_chunk_of_another_space_than_declared_is_refused(other: ControlSpace) -> None:
    agreement = agreed(robot_space("joint_position", ROBOT, 10.0))
    row = np.zeros(other.size)
    with pytest.raises(InvalidInputError, match=r"answered in .*; it declares joint_position"):
        agreement.convert(chunk_of(other, row.tolist()), None)


def test_units_that_differ_are_told() -> None:
    agreement = agreed(robot_space("joint_position", ROBOT))
    other = joint_space("joint_position", (*ARM, GRIPPER), a="deg")
    with pytest.raises(InvalidInputError, match="with other units or frames; it declares"):
        agreement.convert(chunk_of(other, [0.0, 0, 0, 0]), None)


@pytest.mark.parametrize(("step_s", "is_good"), [(0.1, True), (0.101, True), (0.2, False)])
def test_the_period_of_a_chunk_is_the_declared_one(step_s: float, is_good: bool) -> None:
    agreement = agreed(robot_space("joint_velocity", ROBOT, 10.0))
    chunk = chunk_of(agreement.declared, [0.0, 0, 0, 0], step_s=step_s)
    if is_good:
        assert agreement.convert(chunk, None).step_s == step_s
        return
    with pytest.raises(InvalidInputError, match="with 5 rows a second; it declares 10"):
        agreement.convert(chunk, None)


def pair() -> RobotProfile:
    """A robot with two arms."""
    arms = tuple(
        ArmProfile(
            name=side, joints=(f"{side}_a", f"{side}_b"), base_link="base", tcp_link=f"{side}_tcp"
        )
        for side in ("left", "right")
    )
    joints = tuple(joint for arm in arms for joint in arm.joints)
    return RobotProfile(name="pair", base_link="base", arm_joints=joints, arms=arms)


def test_a_chunk_that_changes_its_arms_midway_is_refused() -> None:
    both = robot_space("joint_position", pair(), 10.0)
    agreement = agree(both, pair(), SPACE_KINDS, backend="policy", controller="ik")
    row = [0.1, 0.2, 0.3, 0.4]
    assert agreement.convert(chunk_of(both, row), None).actions.tolist() == [row]
    left = replace(both, channels=both.channels[:2])
    swapped = replace(both, channels=(*both.channels[2:], *both.channels[:2]))
    fast = robot_space("joint_velocity", pair(), 10.0)
    told = "it declares joint_position (left/left_a, left/left_b, right/right_a, right/right_b"
    for other in (left, swapped, fast, EE_DELTA):
        numbers = np.zeros(other.size).tolist()
        with pytest.raises(InvalidInputError, match=re.escape(told)):
            agreement.convert(chunk_of(other, numbers), None)


def test_fourteen_values_for_one_arm_are_no_chunk() -> None:
    with pytest.raises(InvalidInputError, match="14"):
        chunk_of(robot_space("joint_position", ROBOT, 10.0), np.zeros(14).tolist())
