"""Units, frames, rotations and gripper signs: known values by hand, and both directions as a
property.
"""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rn_vla.rotation import matrix_from_rpy, nearer_rotvec, rpy_from_matrix
from rn_vla.tcp_actions import ActionLayout, FrameName, Gripper, Meaning, Rotation
from rn_vla.tcp_profiles import PROFILES
from rn_vla.tcp_state import StateLayout
from roboneuron.contract import Action, Observation, Pose, apply_delta
from roboneuron.contract.rotation import (
    matrix_from_quaternion,
    matrix_from_rotvec,
    quaternion_from_matrix,
)
from roboneuron.errors import ConfigurationError, UngroundedError, UnsafeError

ORIGIN = np.zeros(3)
NO_STATE = np.zeros(8)
# A quarter turn about z: the TCP's x axis is the base's y axis.
QUARTER = Pose(
    position_m=np.array([0.4, 0.1, 0.3]),
    quaternion_xyzw=np.array([0, 0, np.sqrt(0.5), np.sqrt(0.5)]),
)
LAYOUTS = [
    ActionLayout(
        meaning=meaning,
        frame=frame,
        rotation=rotation,
        gripper=gripper,
        step_s=0.1,
        translation_scale_m=0.05,
        rotation_scale_rad=0.5,
        adds_state=adds_state,
    )
    for meaning in get_args(Meaning)
    for frame in get_args(FrameName)
    for rotation in get_args(Rotation)
    for gripper in get_args(Gripper)
    for adds_state in (False, True)
]


def _to(
    layout: ActionLayout, raw: list[float], pose: Pose | None = None, state: np.ndarray = NO_STATE
) -> np.ndarray:
    out: np.ndarray = layout.to_contract(
        np.array([raw]), state=state, pose=pose, base_position_m=ORIGIN
    )[0]
    return out


@settings(max_examples=150, deadline=None)
@given(
    layout=st.sampled_from(LAYOUTS),
    moves=arrays(np.float64, (3, 6), elements=st.floats(-0.2, 0.2)),
    openings=arrays(np.float64, 3, elements=st.floats(0, 1)),
    state=arrays(np.float64, 8, elements=st.floats(-1, 1)),
)
def test_there_and_back_gives_the_same_actions(
    layout: ActionLayout, moves: np.ndarray, openings: np.ndarray, state: np.ndarray
) -> None:
    actions = np.column_stack([moves, openings])
    base = np.array([-0.6, 0.1, 0.9])
    raw = layout.from_contract(actions, state=state, pose=QUARTER, base_position_m=base)
    again = layout.to_contract(raw, state=state, pose=QUARTER, base_position_m=base)
    # Rotation matrices and scaling by 0.05 lose a few digits of 1e-16 each.
    np.testing.assert_allclose(again, actions, atol=1e-8, rtol=0)


def test_libero_units_become_metres_and_radians_and_closing_is_plus_one() -> None:
    layout = PROFILES["libero"].action
    out = _to(layout, [1.0, -0.5, 0.2, 0.0, 0.0, 0.4, -1.0])
    np.testing.assert_allclose(out, [0.05, -0.025, 0.01, 0, 0, 0.2, 1.0], atol=1e-12)
    assert _to(layout, [0, 0, 0, 0, 0, 0, 1.0])[6] == 0.0
    assert _to(layout, [0, 0, 0, 0, 0, 0, 0.0])[6] == 0.5
    assert layout.step_s == 0.05


def test_libero_values_beyond_one_are_clipped_before_scaling_as_robosuite_does() -> None:
    out = _to(PROFILES["libero"].action, [7.0, -7.0, 0, 0, 0, 9.0, -3.0])
    np.testing.assert_allclose(out, [0.05, -0.05, 0, 0, 0, 0.5, 1.0], atol=1e-12)


def test_libero_openpi_adds_the_state_to_six_values_but_not_to_the_gripper() -> None:
    state = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
    relative = _to(PROFILES["libero-openpi"].action, [0.0] * 6 + [1.0], state=state)
    np.testing.assert_allclose(
        relative, _to(PROFILES["libero"].action, [*state[:6], 1.0]), atol=1e-12
    )


def test_bridge_takes_metres_roll_pitch_yaw_and_one_is_open() -> None:
    out = _to(PROFILES["bridge"].action, [0.01, 0.02, 0.03, 0.1, 0.2, 0.3, 1.0])
    np.testing.assert_allclose(out[:3], [0.01, 0.02, 0.03])
    np.testing.assert_allclose(
        matrix_from_rotvec(out[3:6]), matrix_from_rpy(np.array([0.1, 0.2, 0.3])), atol=1e-12
    )
    assert out[6] == 1.0
    assert PROFILES["bridge"].action.step_s == 0.2


def test_a_delta_in_the_tcp_frame_is_turned_into_the_base_frame_step_by_step() -> None:
    layout = ActionLayout(
        meaning="delta", frame="tcp", rotation="rotvec", gripper="open_fraction", step_s=0.1
    )
    raw = np.array([[0.1, 0, 0, 0, 0, np.pi / 2, 0], [0.1, 0, 0, 0, 0, 0, 0]])
    out = layout.to_contract(raw, state=NO_STATE, pose=QUARTER, base_position_m=ORIGIN)
    np.testing.assert_allclose(out[0, :6], [0, 0.1, 0, 0, 0, np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(out[1, :3], [-0.1, 0, 0], atol=1e-12)


def test_absolute_targets_are_reached_by_applying_the_deltas_one_after_another() -> None:
    layout = ActionLayout(
        meaning="absolute", frame="base", rotation="rpy", gripper="open_fraction", step_s=0.1
    )
    base = np.array([-0.6, 0.0, 0.9])
    targets = np.array(
        [[-0.1, 0.2, 1.3, 3.0, 0.1, 0.2, 1.0], [-0.2, 0.1, 1.2, -3.1, 0.0, 0.5, 0.0]]
    )
    out = layout.to_contract(targets, state=NO_STATE, pose=QUARTER, base_position_m=base)
    pose = QUARTER
    for action, target in zip(out, targets, strict=True):
        pose = apply_delta(pose, Action.from_vector(action))
        np.testing.assert_allclose(pose.position_m, target[:3] - base, atol=1e-9)
        expected = matrix_from_rpy(target[3:6])
        np.testing.assert_allclose(
            matrix_from_quaternion(pose.quaternion_xyzw), expected, atol=1e-9
        )


def test_without_a_pose_absolute_and_tcp_actions_are_refused() -> None:
    for layout in LAYOUTS:
        if layout.meaning == "absolute" or layout.frame == "tcp":
            with pytest.raises(UngroundedError, match="ee_pose"):
                _to(layout, [0.0] * 7)
        else:
            assert np.isfinite(_to(layout, [0.0] * 7)).all()


def test_wrong_widths_and_non_finite_actions_are_refused() -> None:
    layout = PROFILES["libero"].action
    for shape in ((0, 7), (5, 8), (5, 14), (7,)):
        with pytest.raises(ConfigurationError, match="shape"):
            layout.to_contract(np.zeros(shape), state=NO_STATE, pose=None, base_position_m=ORIGIN)
    for bad in (np.nan, np.inf):
        with pytest.raises(UnsafeError, match="step 0, column 6"):
            _to(layout, [0.0] * 6 + [bad])


@settings(max_examples=50, deadline=None)
@given(arrays(np.float64, 3, elements=st.floats(-1.5, 1.5)))
def test_roll_pitch_yaw_there_and_back(rpy: np.ndarray) -> None:
    np.testing.assert_allclose(rpy_from_matrix(matrix_from_rpy(rpy)), rpy, atol=1e-7)


def test_roll_pitch_yaw_at_the_pole_still_gives_the_same_rotation() -> None:
    matrix = matrix_from_rpy(np.array([0.3, np.pi / 2, 0.2]))
    np.testing.assert_allclose(matrix_from_rpy(rpy_from_matrix(matrix)), matrix, atol=1e-7)


def _observation(quaternion: np.ndarray, opening: float = 0.25) -> Observation:
    pose = Pose(position_m=np.array([0.4, 0.1, 0.3]), quaternion_xyzw=quaternion)
    return Observation(frames={}, instruction="x", ee_pose=pose, gripper_open=opening)


def test_the_libero_state_is_position_rotation_vector_and_two_fingers() -> None:
    layout = replace(PROFILES["libero"].state, base_position_m=np.array([-0.66, 0.0, 0.9]))
    state = layout.build(_observation(np.array([1.0, 0.0, 0.0, 0.0])))
    np.testing.assert_allclose(state, [-0.26, 0.1, 1.2, np.pi, 0, 0, 0.01, -0.01], atol=1e-12)
    assert layout.width == 8


@pytest.mark.parametrize("tilt_rad", [-0.2, -1e-6, 1e-6, 0.2])
def test_the_rotation_vector_of_a_gripper_pointing_down_never_flips(tilt_rad: float) -> None:
    rotation = matrix_from_rotvec(np.array([np.pi + tilt_rad, 0.0, 0.0]))
    state = PROFILES["libero"].state.build(_observation(quaternion_from_matrix(rotation)))
    np.testing.assert_allclose(state[3:6], [np.pi + tilt_rad, 0, 0], atol=1e-7)


def test_the_nearer_rotation_vector_is_the_same_rotation() -> None:
    rotvec = np.array([-2.0, 1.0, 0.5])
    other = nearer_rotvec(rotvec, np.array([np.pi, 0, 0]))
    assert other[0] > 0
    np.testing.assert_allclose(matrix_from_rotvec(other), matrix_from_rotvec(rotvec), atol=1e-12)
    np.testing.assert_array_equal(nearer_rotvec(np.zeros(3), np.ones(3)), np.zeros(3))


def test_the_bridge_state_is_level_when_the_gripper_points_down() -> None:
    state = PROFILES["bridge"].state.build(_observation(np.array([1.0, 0.0, 0.0, 0.0])))
    np.testing.assert_allclose(state, [0.4, 0.1, 0.3, 0, 0, 0, 0, 0.25], atol=1e-12)


def test_every_term_has_its_width() -> None:
    layout = StateLayout(
        terms=(
            "position",
            "rotvec",
            "rpy",
            "quaternion",
            "gripper_open",
            "gripper_closed",
            "fingers",
        )
    )
    state = layout.build(_observation(np.array([0.0, 0.0, 0.0, -1.0])))
    assert len(state) == layout.width == 17
    np.testing.assert_allclose(state[9:15], [0, 0, 0, 1, 0.25, 0.75])


def test_a_state_that_is_not_finite_is_unsafe() -> None:
    with pytest.raises(UnsafeError, match="non-finite"):
        PROFILES["libero"].state.build(_observation(np.array([1.0, 0, 0, 0]), opening=float("nan")))
