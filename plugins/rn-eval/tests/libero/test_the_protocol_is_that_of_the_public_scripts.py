"""The inputs of backends and of the simulator equal those computed by the functions of the public
evaluation scripts.

The arrays were created with those functions; golden/README.md names the source. No simulator is
needed.
"""

from __future__ import annotations

import argparse
import json

import numpy as np
import pytest

from rn_backend_oft.state import read_state
from rn_eval.command import Eval
from rn_eval.command_plans import planned
from rn_eval.hooks import SuiteSpec
from rn_eval.libero.suite import STEP_LIMITS, tasks_of, to_simulator
from rn_vla.openvla.preprocessing import Preprocessor, TowerPixels
from rn_vla.openvla.profiles import PROFILES
from roboneuron import JointSample, Observation, Pose
from roboneuron.plugins.discovery import discover

IMAGES = ("libero_spatial/3/0/0", "libero_object/7/0/24", "libero_10/2/0/24")


def options_of(suite, backend):
    parser = argparse.ArgumentParser()
    Eval().configure(parser)
    given = parser.parse_args(["run", "--suite", suite, "--backend", backend])
    return planned(given).config["plugins"][backend]


@pytest.mark.parametrize("at", IMAGES)
@pytest.mark.parametrize(
    ("raw", "expected"), [("agentview_raw", "full_cropped"), ("wrist_raw", "wrist_cropped")]
)
def test_images_are_preprocessed_alike(golden, at, raw, expected):
    """JPEG and crop are exact; the resize sums in another order, so a value at a rounding boundary
    may differ by 1.
    """
    steps = options_of("libero-spatial", "oft")["image_steps"]
    tower = TowerPixels(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
    seen = Preprocessor(size=224, towers=(tower,), steps=tuple(steps)).to_model_image(
        np.ascontiguousarray(golden[f"{at}/{raw}"][::-1, ::-1])  # as in the suite's observation
    )
    difference = np.abs(seen.astype(int) - golden[f"{at}/{expected}"].astype(int))
    assert difference.max() <= 1
    assert (difference > 0).mean() < 3e-4


def test_actions_are_processed_alike(golden):
    """Model values are converted to the contract's units and back, with one rounding each way."""
    native, expected = golden["process/in"], golden["process/out"]
    sent = np.array([to_simulator(row) for row in PROFILES["libero"].to_contract(native)])
    inside = expected.copy()
    inside[:, :6] = np.clip(expected[:, :6], -1.0, 1.0)  # as robosuite's controller does first
    assert np.abs(sent[:, :6] - inside[:, :6]).max() < 4e-16
    middle = native[:, 6] == 0.5  # the scripts send 0 there; a rounded opening has no middle
    assert np.array_equal(sent[~middle, 6], inside[~middle, 6])
    assert middle.sum() <= 1


def test_the_state_is_read_alike(golden):
    names = ("panda_finger_joint1", "panda_finger_joint2")
    for quaternion, expected in zip(golden["quat/in"], golden["quat/out"], strict=True):
        observation = Observation(
            frames={},
            instruction="x",
            joints=JointSample(names=names, position=np.array([0.0387, -0.0388])),
            ee_pose=Pose(position_m=np.array([0.1, 0.2, 0.3]), quaternion_xyzw=quaternion),
            gripper_open=0.9,
        )
        state = read_state(
            observation,
            "xyz_rotvec_fingers",
            finger_travel_m=0.04,
            origin_m=np.zeros(3),
            finger_joints=names,
            by_quaternion=True,
        )
        np.testing.assert_allclose(state, [0.1, 0.2, 0.3, *expected, 0.0387, -0.0388], rtol=1e-14)


def test_step_limits_are_the_same(golden):
    limits = json.loads(str(golden["step_limits"]))
    assert {name: limits[name] for name in STEP_LIMITS} == dict(STEP_LIMITS)


def test_sentences_are_the_same(golden):
    for key in (name for name in golden if name.endswith("/description")):
        suite, task, *_ = key.split("/")
        assert tasks_of(suite)[int(task)][1] == str(golden[key])


def test_each_suite_asks_backends_for_its_data_set():
    assert options_of("libero-goal", "openvla")["unnorm_key"] == "libero_goal"
    assert options_of("libero-goal", "oft")["state_rotation"] == "quaternion"
    assert options_of("libero-10", "oft")["unnorm_key"] == "libero_10"
    assert {name for name in discover().specs(SuiteSpec) if name.startswith("libero-")} == {
        suite.replace("_", "-") for suite in STEP_LIMITS
    }
