"""Profiles answer by name and unit: cameras, openings, calibrations at other resolutions; errors
tell what to do.
"""

from __future__ import annotations

import inspect
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rn_testing.fakes import gantry_profile
from roboneuron import errors
from roboneuron.contract import (
    ArmProfile,
    CameraCalibration,
    CameraProfile,
    GripperProfile,
    JointCommand,
    JointSample,
)

GRIPPERS = st.builds(
    lambda closed, span, sign: GripperProfile(
        joint="f", closed_position=closed, open_position=closed + sign * span
    ),
    st.floats(-1, 1),
    st.floats(0.01, 1),
    st.sampled_from([-1, 1]),
)


@given(GRIPPERS, st.floats(0, 1))
def test_an_opening_survives_the_round_trip_in_either_direction_of_travel(gripper, opening):
    assert abs(gripper.to_opening(gripper.to_position(opening)) - opening) < 1e-9


@given(GRIPPERS, st.floats(-10, 10))
def test_a_measured_opening_is_always_between_closed_and_open(gripper, position):
    assert 0.0 <= gripper.to_opening(position) <= 1.0


@given(GRIPPERS)
def test_a_position_that_is_no_number_is_no_closed_gripper(gripper):
    assert np.isnan(gripper.to_opening(float("nan")))


FINGER = GripperProfile(joint="f", closed_position=0.0, open_position=0.04)
FORMS = {
    "mapping": dict,
    "sample": lambda by_name: JointSample(names=tuple(by_name), position=[*by_name.values()]),
    "command": lambda by_name: JointCommand(
        names=tuple(by_name), position=[*by_name.values()], duration_s=0.1
    ),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("by_name", "opening"),
    [
        ({"a": 1.0, "f": 0.01}, 0.25),
        ({"f": 9.0, "a": 1.0}, 1.0),
        ({"a": 1.0}, None),
        ({}, None),
        ({"f": np.nan}, None),
        ({"f": np.inf}, None),
        ({"f": -np.inf}, None),
    ],
)
def test_an_opening_is_measured_or_none(form, by_name, opening):
    joints = FORMS[form](by_name)
    arm = ArmProfile(name="", joints=("a",), base_link="base", tcp_link="tcp", gripper=FINGER)
    assert FINGER.opening_in(joints) == arm.opening_in(joints) == opening
    assert replace(arm, gripper=None).opening_in(joints) is None
    assert arm.opening_in(None) is None


def test_cameras_are_found_by_name():
    profile = gantry_profile()
    assert profile.camera("hand").role == "wrist"
    assert profile.camera("wrist") is None


def _camera() -> CameraProfile:
    intrinsics = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
    calibration = CameraCalibration(intrinsics=intrinsics, mount="base", T_mount_camera=np.eye(4))
    return CameraProfile(
        name="c", role="primary", frame_id="f", width=640, height=480, calibration=calibration
    )


def test_a_calibration_scales_with_the_image():
    scaled = _camera().calibration_at(320, 240)
    np.testing.assert_allclose(scaled.intrinsics, [[250, 0, 160], [0, 250, 120], [0, 0, 1]])
    np.testing.assert_array_equal(scaled.T_mount_camera, np.eye(4))


def test_a_calibration_of_another_aspect_ratio_is_unknown():
    assert _camera().calibration_at(480, 480) is None


def test_every_error_has_a_code_of_its_own_and_a_docstring():
    classes = [
        c
        for _, c in inspect.getmembers(errors, inspect.isclass)
        if issubclass(c, errors.RoboNeuronError)
    ]
    codes = [c.code for c in classes]
    assert len(set(codes)) == len(codes)
    assert all(c.__doc__ for c in classes)


def test_an_error_reads_as_message_and_hint():
    error = errors.MissingDependencyError("Needs torch.", hint="Run: pip install torch")
    assert str(error) == "Needs torch. Run: pip install torch"
    assert str(errors.StateError("Not running.")) == "Not running."


@pytest.mark.parametrize("name", ["upper", "lower", "velocity", "acceleration", "effort"])
def test_each_profile_has_limits_of_its_own(name):
    first, second = gantry_profile(), gantry_profile()
    assert not np.shares_memory(getattr(first.limits, name), getattr(second.limits, name))
