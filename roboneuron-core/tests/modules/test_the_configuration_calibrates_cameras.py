"""`[robot.cameras.<name>]` replaces the calibration of the robot's profile."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rn_testing.fakes import FAKE_ROBOT, fake_registry, gantry_profile
from roboneuron.config import RobotConfig, parse_config
from roboneuron.contract import CameraCalibration, RobotProfile
from roboneuron.errors import ConfigurationError
from roboneuron.modules.plugin import load_profile

MOUNTED = {
    "mount": "base",
    "position_m": [1.0, 0.5, 0.25],
    "quaternion_xyzw": [0.0, 1.0, 0.0, 0.0],
}
OPTICS = {"size": [640, 480], "intrinsics": [600.0, 610.0, 319.5, 239.5]}


INTRINSICS = np.array([[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])


def seeing_profile() -> RobotProfile:
    """The fake robot with a calibrated camera on its hand."""
    profile = gantry_profile()
    calibration = CameraCalibration(intrinsics=INTRINSICS, mount="tcp", T_mount_camera=np.eye(4))
    front, hand = profile.cameras
    return replace(profile, name="seeing", cameras=(replace(front, calibration=calibration), hand))


def _robot(camera: str, *, name: str = "gantry", **values: object) -> RobotConfig:
    return RobotConfig.model_validate({"name": name, "cameras": {camera: MOUNTED | values}})


def test_a_measured_pose_replaces_that_of_the_profile():
    spec = replace(FAKE_ROBOT, name="seeing", target=f"{__name__}:seeing_profile")
    robot = _robot("front", name="seeing")
    camera = load_profile(fake_registry(spec), robot).camera("front")
    assert camera.calibration.mount == "base"
    assert camera.calibration.T_mount_camera[:3, 3].tolist() == [1.0, 0.5, 0.25]
    assert np.allclose(camera.calibration.T_mount_camera[:3, :3], np.diag([-1.0, 1.0, -1.0]))
    assert np.array_equal(camera.calibration.intrinsics, INTRINSICS)
    assert (camera.width, camera.height) == (64, 48)


def test_measured_intrinsics_are_those_of_their_size_with_half_pixels():
    camera = load_profile(fake_registry(), _robot("front", **OPTICS)).camera("front")
    assert camera.calibration_at(640, 480).intrinsics.tolist() == [
        [600.0, 0.0, 320.0],
        [0.0, 610.0, 240.0],
        [0.0, 0.0, 1.0],
    ]
    assert camera.calibration_at(320, 240).intrinsics[0, 2] == 160.0


def test_a_camera_that_was_never_calibrated_is_calibrated_on_the_hand():
    registry = fake_registry()
    assert load_profile(registry, "gantry").camera("hand").calibration is None
    camera = load_profile(registry, _robot("hand", mount="tcp", **OPTICS)).camera("hand")
    assert camera.calibration.arm == ""


@pytest.mark.parametrize(
    ("camera", "values", "told"),
    [
        ("back", {}, "front, hand"),
        ("front", {"mount": "left/tcp"}, "left/tcp"),
        ("hand", {}, "intrinsics"),
    ],
)
def test_a_calibration_that_does_not_fit_the_robot_is_refused(camera, values, told):
    with pytest.raises(ConfigurationError, match=told):
        load_profile(fake_registry(), _robot(camera, **values))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mount", '"world"'),
        ("position_m", "[1.0, 2.0]"),
        ("position_m", "[1.0, 2.0, 1000.0]"),
        ("quaternion_xyzw", "[0.0, 0.0, 0.0, 0.9]"),
        ("size", "[640, 480]"),
        ("intrinsics", "[600.0, 610.0, 319.5, 239.5]"),
        ("intrinsics", "[0.0, 610.0, 319.5, 239.5]\nsize = [640, 480]"),
        ("fov_deg", "60.0"),
    ],
)
def test_a_wrong_value_names_its_table(key, value):
    table = {"mount": '"base"', "position_m": "[1, 0, 0]", "quaternion_xyzw": "[0, 0, 0, 1]"}
    lines = "\n".join(f"{name} = {given}" for name, given in (table | {key: value}).items())
    text = f'[robot]\nname = "gantry"\n[robot.cameras.front]\n{lines}\n'
    with pytest.raises(ConfigurationError, match=r"robot\.cameras\.front"):
        parse_config(text)
