from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from rn_vla.openvla.bins import ActionBins
from rn_vla.openvla.options import OpenVlaModelOptions
from rn_vla.openvla.preprocessing import Preprocessor, TowerPixels
from rn_vla.openvla.profiles import PROFILES, ActionProfile
from rn_vla.openvla.statistics import Scaling, VectorStatistics
from roboneuron.contract import Pose
from roboneuron.contract.rotation import matrix_from_rotvec, quaternion_from_matrix

UNIT = st.floats(-0.95, 0.95)
SIX = st.lists(UNIT, min_size=6, max_size=6)
SIGNS = ["open_fraction", "closed_fraction", "signed_open", "signed_close"]


def _profile(**changes) -> ActionProfile:
    return ActionProfile(
        **(
            {
                "metres_per_unit": 0.05,
                "radians_per_unit": 0.5,
                "rotation": "rotvec",
                "frame": "base",
                "gripper": "open_fraction",
                "gripper_threshold": False,
                "clip_units": False,
                "step_s": 0.1,
            }
            | changes
        )
    )


def test_libero_units_become_metres_radians_and_opening():
    native = np.array([[1.0, -1.0, 0.5, 1.0, -0.5, 0.0, 0.9], [2.0, -3.0, 0, 0, 0, 0, 0.1]])
    expected = [[0.05, -0.05, 0.025, 0.5, -0.25, 0.0, 1.0], [0.05, -0.05, 0, 0, 0, 0, 0.0]]
    np.testing.assert_allclose(PROFILES["libero"].to_contract(native), expected, atol=1e-12)


def test_bridge_values_are_metres_and_roll_pitch_yaw():
    native = np.array([[0.01, -0.02, 0.03, 0.1, 0.2, 0.3, 0.7]])
    contract = PROFILES["bridge"].to_contract(native)[0]
    x, y, z = (matrix_from_rotvec(np.eye(3)[i] * native[0, 3 + i]) for i in range(3))
    np.testing.assert_allclose(contract[:3], native[0, :3])
    np.testing.assert_allclose(matrix_from_rotvec(contract[3:6]), z @ y @ x, atol=1e-12)
    assert contract[6] == 1.0


@pytest.mark.parametrize(
    ("gripper", "closed", "opened"),
    [
        ("open_fraction", 0, 1),
        ("closed_fraction", 1, 0),
        ("signed_open", -1, 1),
        ("signed_close", 1, -1),
    ],
)
def test_each_gripper_sign_opens_and_closes(gripper, closed, opened):
    native = np.zeros((2, 7))
    native[:, 6] = closed, opened
    assert _profile(gripper=gripper).to_contract(native)[:, 6].tolist() == [0.0, 1.0]


@pytest.mark.parametrize("name", sorted(PROFILES))
@given(rows=st.lists(SIX, min_size=1, max_size=4), opening=st.sampled_from([0.0, 1.0]))
@settings(max_examples=25, deadline=None)
def test_profiles_convert_to_the_contract_and_back(name, rows, opening):
    native = np.column_stack([np.array(rows), np.full(len(rows), opening)])
    profile = PROFILES[name]
    np.testing.assert_allclose(profile.to_native(profile.to_contract(native)), native, atol=1e-9)


@given(
    rows=st.lists(SIX, min_size=1, max_size=4),
    turn=st.lists(UNIT, min_size=3, max_size=3),
    rotation=st.sampled_from(["rotvec", "rpy"]),
    gripper=st.sampled_from(SIGNS),
)
@settings(max_examples=40, deadline=None)
def test_tool_frame_profiles_convert_to_the_contract_and_back(rows, turn, rotation, gripper):
    profile = _profile(frame="tcp", rotation=rotation, gripper=gripper)
    pose = Pose(
        position_m=np.zeros(3),
        quaternion_xyzw=quaternion_from_matrix(matrix_from_rotvec(3 * np.array(turn))),
    )
    native = np.column_stack([np.array(rows), np.full(len(rows), 0.5)])
    np.testing.assert_allclose(
        profile.to_native(profile.to_contract(native, pose), pose), native, atol=1e-9
    )


def test_tool_frame_chunks_end_where_moving_along_the_tool_ends():
    """Composed deltas in the tool frame, and their contract form in the base frame, give the same
    final pose.
    """
    rng = np.random.default_rng(0)
    native = np.column_stack([rng.uniform(-1, 1, (5, 6)), np.ones(5)])
    axes = matrix_from_rotvec(np.array([0.3, -2.0, 0.7]))
    pose = Pose(position_m=np.zeros(3), quaternion_xyzw=quaternion_from_matrix(axes))
    position, rotation = np.zeros(3), axes
    for row in native:
        position = position + rotation @ (row[:3] * 0.05)
        rotation = rotation @ matrix_from_rotvec(row[3:6] * 0.5)
    moved, turned = np.zeros(3), axes
    for row in _profile(frame="tcp").to_contract(native, pose):
        moved, turned = moved + row[:3], matrix_from_rotvec(row[3:6]) @ turned
    np.testing.assert_allclose(moved, position, atol=1e-12)
    np.testing.assert_allclose(turned, rotation, atol=1e-12)


def test_edge_tokens_give_the_values_of_the_original():
    bins = ActionBins(256, 32000)
    values = bins.to_values(np.array([31999, 31745, 31744, 31743, 0]))
    np.testing.assert_allclose(values, [-0.99608, 0.99608, 0.99608, 0.99608, 0.99608], atol=1e-5)


@given(values=st.lists(st.floats(-2, 2), min_size=1, max_size=9))
def test_values_survive_their_tokens_within_half_a_bin(values):
    bins = ActionBins(256, 32000)
    back = bins.to_values(bins.to_tokens(np.array(values)))
    np.testing.assert_allclose(back, np.clip(values, -1, 1), atol=1.01 / 255)


def test_masked_values_pass_through_and_bounds_are_chosen():
    statistics = VectorStatistics(
        min=(-4, -4), max=(4, 4), q01=(-2, -2), q99=(2, 2), mask=(True, False)
    )
    for bounds, edge in (("q99", 2.0), ("minmax", 4.0)):
        scaling = Scaling.of(statistics, bounds, 0.0)
        np.testing.assert_allclose(scaling.to_units(np.array([1.0, 0.5])), [edge, 0.5])
        np.testing.assert_allclose(scaling.to_normalized(np.array([edge * 3, 0.5])), [1.0, 0.5])


def test_masked_proprioception_is_clipped_as_in_the_public_code():
    """`normalize_proprio` of OpenVLA-OFT clips what its mask passes through."""
    statistics = VectorStatistics(
        min=(-4, -4), max=(4, 4), q01=(-2, -2), q99=(2, 2), mask=(True, False)
    )
    scaling = Scaling.of(statistics, "q99", 1e-8)
    np.testing.assert_allclose(scaling.to_normalized(np.array([1.0, 3.0])), [0.5, 1.0], atol=1e-8)
    np.testing.assert_allclose(scaling.to_normalized(np.array([-9.0, -1.5])), [-1.0, -1.0])


def test_the_centre_crop_takes_the_middle_nine_tenths_of_the_area():
    ramp = np.tile(np.linspace(0, 255, 224).astype(np.uint8)[:, None, None], (1, 224, 3))
    cropped = Preprocessor(size=224, towers=(), steps=("center_crop_90",)).to_model_image(ramp)
    assert cropped.shape == (224, 224, 3)
    edge = 255 * (1 - np.sqrt(0.9)) / 2
    assert abs(cropped[0, 0, 0] - edge) < 2  # rounded down to a whole level twice
    assert abs(cropped[-1, 0, 0] - (255 - edge)) < 2


def test_image_steps_run_in_the_given_order():
    image = np.zeros((240, 320, 3), dtype=np.uint8)
    image[:10, :10] = 255
    steps = ("rotate_180", "jpeg_95", "resize_lanczos", "center_crop_90")
    made = Preprocessor(size=224, towers=(), steps=steps).to_model_image(image)
    assert made.shape == (224, 224, 3)
    assert (
        Preprocessor(size=224, towers=(), steps=("rotate_180",)).to_model_image(image)[-1, -1, 0]
        == 255
    )


def test_tower_channels_follow_each_other():
    towers = (
        TowerPixels(mean=(0, 0, 0), std=(1, 1, 1)),
        TowerPixels(mean=(0.5,) * 3, std=(0.5,) * 3),
    )
    pixels = Preprocessor(size=4, towers=towers).to_pixels(
        np.full((4, 4, 3), [255, 0, 51], dtype=np.uint8)
    )
    np.testing.assert_allclose(pixels[:, 0, 0], [1, 0, 0.2, 1, -1, -0.6], atol=1e-6)


def test_an_own_profile_must_be_said_and_only_when_own(tmp_path):
    with pytest.raises(ValidationError, match="own_profile"):
        OpenVlaModelOptions(checkpoint=tmp_path, profile="own")
    with pytest.raises(ValidationError, match="own_profile"):
        OpenVlaModelOptions(
            checkpoint=tmp_path,
            profile="libero",
            own_profile={
                "metres_per_unit": 1,
                "radians_per_unit": 1,
                "rotation": "rpy",
                "gripper": "signed_open",
                "step_s": 1,
            },
        )
    with pytest.raises(ValidationError, match="profile"):
        OpenVlaModelOptions(checkpoint=tmp_path)
