"""Controllers whose joint states carry no velocities: a stop begins with difference quotients."""

from __future__ import annotations

import math

import pytest
from sensor_msgs.msg import JointState

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_driver_ros2control.link import MeasuredJoint, measured_joints


def after(*reports: tuple[float, float], velocity: list[float] | None = None) -> MeasuredJoint:
    """The joint after reports of a position [rad] at a time [s]."""
    joints: dict[str, MeasuredJoint] = {}
    for received_s, position in reports:
        message = JointState(name=["a"], position=[position], velocity=velocity or [])
        joints = measured_joints(message, received_s, joints)
    return joints["a"]


def test_the_velocity_is_the_difference_of_the_last_two_reports():
    assert after((1.0, 0.1), (1.1, 0.2), (1.2, 0.25)).velocity == pytest.approx(0.5)


def test_a_reported_velocity_counts():
    assert after((1.0, 0.1), (1.1, 0.2), velocity=[0.3]).velocity == 0.3


def test_one_report_gives_none():
    assert after((1.0, 0.1)).velocity is None


def test_two_reports_at_once_keep_the_velocity_before():
    assert after((1.0, 0.0), (1.1, 0.1), (1.1001, 0.5)).velocity == pytest.approx(1.0)


def test_a_continuous_joint_that_passes_half_a_turn_does_not_jump():
    assert after((1.0, math.pi - 0.01), (1.1, -math.pi + 0.01)).velocity == pytest.approx(0.2)
