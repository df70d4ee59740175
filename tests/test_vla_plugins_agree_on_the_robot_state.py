"""OFT and pi0 represent the same pose by the same rotation, which is that of the public evaluation
code.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from rn_backend_oft.state import read_state
from rn_vla.tcp_profiles import PROFILES
from roboneuron.contract import Observation, Pose
from roboneuron.contract.rotation import matrix_from_quaternion

DOWN = np.array([1.0, 0.0, 0.0, 0.0])
"""x y z w of a gripper pointing down."""
BRIDGE_REFERENCE = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""DEFAULT_ROTATION of bridge_data_robot's widowx_controller: the WidowX link when its gripper
points down.
"""
LINK_IN_TCP = np.diag([1.0, -1.0, -1.0]) @ BRIDGE_REFERENCE
"""The WidowX link (x out of the gripper) as seen from a TCP (z out of the gripper), both pointing
down.
"""


def _poses(count: int = 1000) -> list[np.ndarray]:
    """Quaternions (x y z w, x > 0) within 9 degrees of gripper-down, on both sides of pi."""
    random = np.random.default_rng(0)
    found = []
    for _ in range(count):
        axis = random.standard_normal(3)
        half = random.uniform(0, math.radians(9)) / 2
        x, y, z = math.sin(half) * axis / np.linalg.norm(axis)
        found.append(np.array([math.cos(half), z, -y, -x]))  # (x, y, z, cos) times (1, 0, 0, 0)
    return found


def _state(plugin: str, platform: str, quaternion: np.ndarray) -> np.ndarray:
    pose = Pose(position_m=np.array([0.4, 0.1, 0.3]), quaternion_xyzw=quaternion)
    observation = Observation(frames={}, instruction="", ee_pose=pose, gripper_open=0.5)
    if plugin == "pi0":
        return PROFILES[platform].state.build(observation)
    layout = {"libero": "xyz_rotvec_fingers", "bridge": "xyz_rpy_opening"}[platform]
    return read_state(observation, layout, finger_travel_m=0.04, origin_m=np.zeros(3))


def _quat2axisangle(quaternion: np.ndarray) -> np.ndarray:
    """The formula of robosuite's transform_utils, for the sign that MuJoCo's body quaternion has
    near gripper-down.
    """
    w = float(np.clip(quaternion[3], -1.0, 1.0))
    return quaternion[:3] * 2.0 * math.acos(w) / math.sqrt(1.0 - w * w)


def _bridge_rpy(quaternion: np.ndarray) -> np.ndarray:
    """SimplerEnv's formula: mat2euler ("sxyz") of the link's rotation against the reference."""
    m = matrix_from_quaternion(quaternion) @ LINK_IN_TCP @ BRIDGE_REFERENCE.T
    return np.array(
        [math.atan2(m[2, 1], m[2, 2]), math.asin(-m[2, 0]), math.atan2(m[1, 0], m[0, 0])]
    )


@pytest.mark.parametrize("plugin", ["oft", "pi0"])
@pytest.mark.parametrize(
    ("platform", "formula"), [("libero", _quat2axisangle), ("bridge", _bridge_rpy)]
)
def test_a_thousand_poses_near_gripper_down_give_the_rotation_of_the_public_evaluation(
    plugin, platform, formula
):
    poses = _poses()
    assert 300 < sum(quaternion[3] < 0 for quaternion in poses) < 700  # both sides of pi
    for quaternion in poses:
        for sign in (1.0, -1.0):  # a measured pose may carry either sign
            rotation = _state(plugin, platform, sign * quaternion)[3:6]
            np.testing.assert_allclose(rotation, formula(quaternion), atol=1e-6)


@pytest.mark.parametrize(
    ("platform", "expected"), [("libero", [math.pi, 0, 0]), ("bridge", [0, 0, 0])]
)
def test_both_plugins_give_the_same_rotation_for_gripper_down(platform, expected):
    for plugin in ("oft", "pi0"):
        np.testing.assert_allclose(_state(plugin, platform, DOWN)[3:6], expected, atol=1e-12)
