"""Seams, predicted states and handovers of chunks in all control spaces."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from roboneuron.contract import (
    EE_DELTA,
    ActionChunk,
    ArmProfile,
    ArmState,
    ControlSpace,
    GripperProfile,
    JointSample,
    Observation,
    Pose,
    RobotProfile,
    robot_space,
)
from roboneuron.contract.rotation import matrix_from_quaternion, rotvec_from_matrix
from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.execution.mode import Abilities, Mode
from roboneuron.modules.execution.queue import SentRowQueue, cross_fade
from roboneuron.modules.execution.roll_forward import roll_forward
from roboneuron.modules.inference.execution import Bounds

STEP_S = 0.1
STEP_NS = round(STEP_S * 1e9)
ROBOT = RobotProfile(
    name="pair",
    base_link="base",
    arm_joints=("a", "b"),
    gripper=GripperProfile(joint="jaw", closed_position=0.0, open_position=0.1),
)
POSITIONS = robot_space("joint_position", ROBOT, 10.0)
VELOCITIES = robot_space("joint_velocity", ROBOT, 10.0)
POSES = robot_space("ee_pose", ROBOT, 10.0)
W_FIRST = replace(POSES, channels=tuple(POSES.channels[i] for i in (6, 3, 4, 5, 0, 1, 2, 7)))
each_space = pytest.mark.parametrize(
    "space", [EE_DELTA, POSITIONS, VELOCITIES, POSES], ids=lambda space: space.kind
)


def row(space: ControlSpace, value: float, opening: float = 1.0) -> np.ndarray:
    """A row that moves by `value`, or to it; its rotation is none."""
    numbers = np.full(space.size, value)
    for part in space.quaternions:
        numbers[part] = [0.0, 0.0, 0.0, 1.0]
    numbers[-1] = opening
    return numbers


def chunk(space: ControlSpace, values: list[float], opening: float = 1.0) -> ActionChunk:
    rows = np.array([row(space, value, opening) for value in values])
    return ActionChunk(actions=rows, step_s=STEP_S, space=space)


def turned(angle_rad: float, sign: float = 1.0) -> np.ndarray:
    """Quaternion of a turn about z."""
    return sign * np.array([0.0, 0.0, np.sin(angle_rad / 2), np.cos(angle_rad / 2)])


# Seams


@each_space
def test_a_seam_is_no_jump_and_the_opening_is_never_half_way(space: ControlSpace) -> None:
    queue = SentRowQueue()
    queue.replace(chunk(space, [0.0] * 16, opening=0.0), 0)
    queue.replace(chunk(space, [1.0] * 16, opening=1.0), 0)
    rows = np.array([queue.pop(0).vector for _ in range(16)])
    assert rows[:, 0] == pytest.approx([0.2, 0.4, 0.6, 0.8, *[1.0] * 12])
    assert (rows[:, -1] == 1.0).all()
    for numbers in rows:
        space.check(numbers)


@each_space
def test_a_seam_of_equal_chunks_changes_nothing(space: ControlSpace) -> None:
    same = chunk(space, [0.1 * i for i in range(16)])
    faded = cross_fade(list(same.actions), same.actions, 4, space)
    np.testing.assert_allclose(faded, same.actions, atol=1e-15)


@pytest.mark.parametrize("space", [POSES, W_FIRST], ids=["x-first", "w-first"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_orientations_are_faded_along_the_shorter_turn(space: ControlSpace, sign: float) -> None:
    """A quaternion and its negative are the same orientation."""
    (part,) = space.quaternions
    old, new = row(space, 0.0), np.array([row(space, 0.0)] * 5)
    old[part] = turned(-0.3)
    new[:, part] = turned(0.3, sign)
    faded = cross_fade([old] * 5, new, 4, space)
    angles = []
    for numbers in faded:
        space.check(numbers)
        assert np.linalg.norm(numbers[part]) == pytest.approx(1.0, abs=1e-12)
        angles.append(rotvec_from_matrix(matrix_from_quaternion(numbers[part]))[2])
    # a blend that is made unit again is no even turn; over 0.6 rad it is within 2 mrad of one
    assert angles == pytest.approx([-0.18, -0.06, 0.06, 0.18, 0.3], abs=2e-3)
    np.testing.assert_array_equal(old[part], turned(-0.3))


# Predicted states


def observation() -> Observation:
    return Observation(
        frames={},
        instruction="go",
        joints=JointSample(names=("jaw", "b", "a"), position=np.array([0.05, 2.0, 1.0])),
        ee_pose=Pose(position_m=np.array([0.3, 0.0, 0.4]), quaternion_xyzw=turned(0.5)),
        gripper_open=0.5,
    )


def test_velocities_move_the_predicted_joints_by_the_time_that_is_left() -> None:
    rows = np.array([[1.0, -2.0, 0.0], [0.5, 1.0, 0.25]])
    measured = observation()
    after = roll_forward(measured, rows, 0.4, VELOCITIES, STEP_S)
    assert after.joints is not None
    expected = [0.05, 2.0 + (-2.0 * 0.6 + 1.0) * STEP_S, 1.0 + (1.0 * 0.6 + 0.5) * STEP_S]
    assert after.joints.position == pytest.approx(expected)
    assert after.gripper_open == 0.25
    assert after.ee_pose is measured.ee_pose


def test_positions_are_where_the_predicted_joints_are() -> None:
    rows = np.array([[0.0, 0.0, 0.0], [0.7, 0.8, 1.0]])
    after = roll_forward(observation(), rows, 0.4, POSITIONS, STEP_S)
    assert after.joints is not None
    assert after.joints.position.tolist() == [0.05, 0.8, 0.7]
    assert after.gripper_open == 1.0


@pytest.mark.parametrize("space", [POSES, W_FIRST], ids=["x-first", "w-first"])
def test_a_pose_is_where_the_predicted_tcp_is(space: ControlSpace) -> None:
    end = dict(zip(POSES.keys, [0.5, 0.1, 0.2, *turned(1.0) * 1.02, 0.0], strict=True))
    after = roll_forward(
        observation(), np.array([[end[key] for key in space.keys]]), 0.0, space, STEP_S
    )
    assert after.ee_pose is not None
    assert after.ee_pose.position_m.tolist() == [0.5, 0.1, 0.2]
    assert after.ee_pose.quaternion_xyzw == pytest.approx(turned(1.0))
    assert after.joints is not None
    assert after.joints.position.tolist() == [0.05, 2.0, 1.0], "not known from a pose"


ARMS = tuple(
    ArmProfile(
        name=name,
        joints=(joint,),
        base_link="base",
        tcp_link=f"{name}_tcp",
        gripper=ROBOT.gripper,
    )
    for name, joint in (("left", "a"), ("right", "b"))
)


@pytest.mark.parametrize("kind", ["ee_pose", "joint_position"])
def test_each_arm_is_where_its_own_channels_lead(kind: str) -> None:
    space = robot_space(kind, replace(ROBOT, arms=ARMS))
    now = observation()
    assert now.ee_pose is not None
    state = ArmState(ee_pose=now.ee_pose, gripper_open=0.5)
    seen = replace(now, arms={"left": state, "right": state})
    at = {"left": 0.4, "right": 0.8}
    row = [
        {"gripper_open": at[channel.arm], "qw": 1.0, "x": at[channel.arm]}.get(channel.name, 0.0)
        for channel in space.channels
    ]
    after = roll_forward(seen, np.array([row]), 0.0, space, STEP_S)
    assert {name: arm.gripper_open for name, arm in after.arms.items()} == at
    assert after.gripper_open == 0.4
    if kind == "ee_pose":
        found = {name: float(arm.ee_pose.position_m[0]) for name, arm in after.arms.items()}
        assert found == at
        assert after.ee_pose is not None
        assert after.ee_pose.position_m[0] == 0.4
    else:
        assert all(arm.ee_pose is now.ee_pose for arm in after.arms.values())


# Rows in progress


def executor(mode: Mode = "predicted-state") -> AdaptiveExecutor:
    abilities = Abilities(takes_predicted_state=True)
    return AdaptiveExecutor(abilities, fixed=mode, bounds=Bounds(first_s=1.0))


def seen(stamp_ns: int) -> Observation:
    now = observation()
    assert now.joints is not None
    assert now.ee_pose is not None
    joints, pose = (replace(one, stamp_ns=stamp_ns) for one in (now.joints, now.ee_pose))
    return replace(now, joints=joints, ee_pose=pose, stamp_ns=stamp_ns)


def test_a_policy_of_velocities_is_told_where_its_rows_lead() -> None:
    made = executor()
    first = made.begin(seen(0), 0)
    assert first.observation.ahead is None
    made.answer(first, chunk(VELOCITIES, [1.0, 1.0, 1.0, 1.0]), 0)
    assert made.play(0.0, 0) is not None
    told = made.begin(seen(STEP_NS // 2), STEP_NS // 2).observation
    assert told.ahead is not None
    assert told.ahead.rows.shape == (4, 3)
    assert told.joints is not None
    assert told.joints.position[1:] == pytest.approx([2.35, 1.35])


@each_space
def test_without_rows_in_progress_the_state_is_the_measured_one(space: ControlSpace) -> None:
    made = executor()
    first = made.begin(seen(0), 0)
    made.answer(first, chunk(space, [0.1]), 0)
    assert made.play(0.0, 0) is not None
    late_ns = 5 * STEP_NS
    told = made.begin(seen(late_ns), late_ns).observation
    assert told.ahead is None
    assert told.joints is not None
    assert told.joints.position.tolist() == [0.05, 2.0, 1.0]


@each_space
def test_rows_of_a_predecessor_in_another_space_count_without_their_numbers(
    space: ControlSpace,
) -> None:
    made = executor()
    made.answer(made.begin(seen(0), 0), chunk(space, [0.1, 0.2, 0.3]), 0)
    made.note_sent(None, 0.0, 0)
    assert made.status().rows == 2, "one row less is to be sent"
    told = made.begin(seen(STEP_NS // 2), STEP_NS // 2).observation
    assert told.ahead is None
    queue = SentRowQueue()
    queue.append(chunk(space, [0.1, 0.2]))
    queue.note_sent(None, 0)
    assert queue.sent_since(0) == 1
    assert queue.ahead(0, 1, STEP_S) is None
    assert queue.ahead(1, 1, STEP_S) is not None


@pytest.mark.parametrize("space", [POSITIONS, VELOCITIES, POSES], ids=lambda space: space.kind)
def test_jumps_are_told_of_tcp_deltas_alone(space: ControlSpace) -> None:
    """Millimetres would be said of radians."""
    told: Counter[str] = Counter()
    for one in (EE_DELTA, space):
        made = executor("sequential")
        made.answer(made.begin(seen(0), 0), chunk(one, [0.1, 0.2, 0.3]), 0)
        for step in range(3):
            assert made.play(step * STEP_S, step * STEP_NS) is not None
        delivery = made.status().delivery
        assert delivery.starved_periods == 0
        told[one.kind] += delivery.inner_jump_mm is not None
    assert told == {"ee_delta": 1, space.kind: 0}
