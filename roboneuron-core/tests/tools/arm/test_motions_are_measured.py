"""The highest speed of a TCP, from poses that are late by different times; margins of joints."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron import JointLimits, JointSample, RobotProfile
from roboneuron.tools.arm.measured import SpeedMeter
from roboneuron.tools.arm.motion_meter import MotionMeter, joint_margin


def pose(t_s: float, x_m: float) -> Any:
    sec, nanosec = divmod(round(t_s * 1e9), 1_000_000_000)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec)),
        pose=SimpleNamespace(
            position=SimpleNamespace(x=x_m, y=0.0, z=0.3),
            orientation=SimpleNamespace(x=1.0, y=0.0, z=0.0, w=0.0),
        ),
    )


def meter() -> MotionMeter:
    host: Any = SimpleNamespace(config=SimpleNamespace(namespace="arm"))
    return MotionMeter(host, "")


def test_the_highest_speed_is_that_of_the_fast_part() -> None:
    made = meter()
    assert made.highest_m_s is None
    random = np.random.default_rng(1)
    x_m = 0.0
    for tick in range(200):
        x_m += 0.02 * (0.2 if 50 <= tick < 100 else 0.05)
        made.note(pose(1.0 + 0.02 * tick, x_m + random.normal(0, 2e-5)))
    assert made.highest_m_s == pytest.approx(0.2, rel=0.03)


def test_stamps_that_are_late_by_different_times_are_no_speed() -> None:
    made = SpeedMeter()
    random = np.random.default_rng(3)
    for tick in range(500):
        at_s = 1.0 + 0.02 * tick
        made.note(at_s + random.uniform(0, 0.006), np.array([0.1 * at_s, 0.0, 0.3]), at_s)
    told = made.fastest_since(0.0)
    assert told is not None
    # two stamps 0.2 s apart that differ by 6 ms
    assert 0.1 <= told <= 0.1 * 1.035


def test_the_joint_that_is_nearest_to_a_limit_is_told() -> None:
    two = np.full(2, 1.0)
    limits = JointLimits(lower=-two, upper=two, velocity=two, acceleration=two, effort=two)
    profile = RobotProfile(name="arm", arm_joints=("a", "b"), limits=limits)
    joints = JointSample(names=("b", "a"), position=np.array([0.9, -0.5]))
    assert joint_margin(profile, joints) == {"b": pytest.approx(0.1)}
    assert joint_margin(profile, None) == {}
    assert joint_margin(RobotProfile(name="arm", arm_joints=("a",)), joints) == {}
