"""Actions: exactly seven finite values, the gripper in [0, 1], applied in the base frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from roboneuron.contract import (
    ACTION_FIELDS,
    EE_DELTA,
    Action,
    ActionChunk,
    Pose,
    apply_delta,
)
from roboneuron.contract.rotation import (
    matrix_from_quaternion,
    matrix_from_rotvec,
    quaternion_from_matrix,
)
from roboneuron.errors import InvalidInputError, UnsafeError

SIX = arrays(np.float64, 6, elements=st.floats(-1.0, 1.0))
POSE = Pose(
    position_m=np.array([0.4, -0.1, 0.3]),
    quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0]),
    stamp_ns=7,
)


@given(SIX, st.floats(0.0, 1.0))
def test_a_vector_survives_the_round_trip(six, gripper):
    vector = np.append(six, gripper)
    np.testing.assert_array_equal(Action.from_vector(vector).to_vector(), vector)


@given(st.integers(0, 12).filter(lambda n: n != 7))
def test_another_size_is_refused(size):
    with pytest.raises(InvalidInputError, match=r"expected \(7,\)"):
        EE_DELTA.check(np.zeros(size))


@given(st.integers(0, 6), st.sampled_from([np.nan, np.inf, -np.inf]))
def test_a_value_that_is_not_finite_is_unsafe_and_named(index, value):
    vector = np.zeros(7)
    vector[index] = value
    with pytest.raises(UnsafeError, match=ACTION_FIELDS[index]):
        EE_DELTA.check(vector)


@pytest.mark.parametrize("gripper", [-0.01, 1.01, 255.0])
def test_a_gripper_outside_its_range_is_refused(gripper):
    with pytest.raises(InvalidInputError, match="gripper_open"):
        EE_DELTA.check([0, 0, 0, 0, 0, 0, gripper])


def test_an_action_does_not_share_memory_with_its_vector():
    vector = np.zeros(7)
    action = Action.from_vector(vector)
    vector[0] = 1.0
    assert action.translation_m[0] == 0.0


@given(SIX)
def test_a_delta_adds_the_translation_and_turns_on_the_left(six):
    start = Pose(
        position_m=np.array([0.1, 0.2, 0.3]), quaternion_xyzw=np.array([0.0, 0.6, 0.0, 0.8])
    )
    moved = apply_delta(start, Action.from_vector(np.append(six, 1.0)))
    np.testing.assert_allclose(moved.position_m, start.position_m + six[:3], atol=1e-15)
    expected = matrix_from_rotvec(six[3:]) @ matrix_from_quaternion(start.quaternion_xyzw)
    np.testing.assert_allclose(matrix_from_quaternion(moved.quaternion_xyzw), expected, atol=1e-12)


def test_a_delta_turns_in_the_base_frame_not_in_the_tool_frame():
    quarter = Action.from_vector([0, 0, 0, 0, 0, np.pi / 2, 1])
    moved = apply_delta(POSE, quarter)  # the tool points down: a half turn about x
    tool_x = matrix_from_quaternion(moved.quaternion_xyzw)[:, 0]
    np.testing.assert_allclose(tool_x, [0, 1, 0], atol=1e-12)


@given(SIX)
def test_a_delta_and_its_opposite_cancel(six):
    there = apply_delta(POSE, Action.from_vector(np.append(six, 1.0)))
    back = apply_delta(there, Action.from_vector(np.append(-six, 1.0)))
    np.testing.assert_allclose(back.position_m, POSE.position_m, atol=1e-12)
    aligned = matrix_from_quaternion(back.quaternion_xyzw)
    np.testing.assert_allclose(aligned, matrix_from_quaternion(POSE.quaternion_xyzw), atol=1e-12)


def test_a_delta_keeps_the_stamp():
    assert apply_delta(POSE, Action.from_vector([0, 0, 0, 0, 0, 0, 1])).stamp_ns == 7


@pytest.mark.parametrize("shape", [(7,), (0, 7), (2, 6), (1, 2, 7)])
def test_a_chunk_of_another_shape_is_refused(shape):
    with pytest.raises(InvalidInputError, match="A chunk has shape"):
        ActionChunk(actions=np.zeros(shape), step_s=0.1)


@pytest.mark.parametrize("step_s", [0.0, -0.1, np.nan, np.inf])
def test_a_chunk_needs_a_positive_finite_step(step_s):
    with pytest.raises(InvalidInputError, match="step_s"):
        ActionChunk(actions=np.zeros((1, 7)), step_s=step_s)


def test_a_chunk_checks_each_of_its_actions():
    actions = np.zeros((3, 7))
    actions[2, 1] = np.nan
    with pytest.raises(UnsafeError, match="dy_m"):
        ActionChunk(actions=actions, step_s=0.1)


def test_a_chunk_of_whole_numbers_becomes_float64():
    chunk = ActionChunk(actions=np.zeros((2, 7), dtype=np.int64), step_s=0.1)  # type: ignore[arg-type]
    assert chunk.actions.dtype == np.float64


def test_quaternions_of_poses_come_back_as_they_went():
    np.testing.assert_allclose(
        quaternion_from_matrix(matrix_from_quaternion(POSE.quaternion_xyzw)), [1, 0, 0, 0]
    )
