"""Rows of joint positions for a joint that turns without end."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from roboneuron import Hold, JointLimits, JointSample, RobotProfile, robot_space

SIX = ("pan", "lift", "elbow", "wrist1", "wrist2", "wrist3")


@pytest.mark.parametrize(
    ("kind", "limits", "start", "goal", "end"),
    [
        ("continuous", (-math.inf, math.inf), 3.1, -3.1, 2 * math.pi - 3.1),
        ("continuous", (-math.inf, math.inf), -9.5, 3.0, 3.0 - 4 * math.pi),
        ("continuous", (-7.0, 7.0), 3.1, -3.1, 2 * math.pi - 3.1),
        ("continuous", (-3.15, 3.15), 3.1, -3.1, "joint_jump"),  # the limits lie between
        ("revolute", (-7.0, 7.0), 3.1, -3.1, "joint_jump"),
    ],
)
def test_a_row_of_positions_takes_a_continuous_joint_the_shorter_way(
    kind, limits, start, goal, end
):
    urdf = (Path(__file__).parent / "data" / "six.urdf").read_text(encoding="utf-8")
    lower, upper = np.full(6, -7.0), np.full(6, 7.0)
    lower[5], upper[5] = limits
    profile = RobotProfile(
        name="six",
        base_link="base",
        tcp_link="tool",
        arm_joints=SIX,
        urdf=urdf.replace('name="wrist3" type="continuous"', f'name="wrist3" type="{kind}"'),
        limits=JointLimits(
            lower=lower,
            upper=upper,
            velocity=np.full(6, 3.0),
            acceleration=np.full(6, 9.0),
            effort=np.ones(6),
        ),
    )
    here = (0.1, -1.0, 0.8, 0.2, 0.3, start)
    space = robot_space("joint_position", profile)
    controller = UrdfController(None, profile)
    controller.load()
    start_joints = JointSample(names=SIX, position=np.array(here))
    result = controller.execute(space, np.array((*here[:5], goal)), start_joints, 0.5)
    if isinstance(result, Hold):
        assert result.code == end
    else:
        np.testing.assert_allclose(result.position, (*here[:5], end))
