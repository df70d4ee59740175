"""The driver without physics keeps every rule of drivers, for each kind of joint and gripper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kinematic_robots import offset_profile, with_profile

from rn_simulation.kinematic_driver import KinematicArmDriver
from rn_testing import RobotCase, RobotContract
from rn_testing.fakes import MemoryTopics, gantry_profile
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    JointCommand,
    RobotProfile,
    StateError,
)


class TestEveryJoint(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        return RobotCase(spec=with_profile("endless_profile"))


@pytest.mark.sampled(every=4)
class TestOtherGrippers(RobotContract):
    @pytest.fixture(params=["offset_profile", "bare_profile"])
    def plugin(self, request: pytest.FixtureRequest) -> RobotCase:
        return RobotCase(spec=with_profile(request.param))


def driver(profile: RobotProfile) -> KinematicArmDriver:
    return KinematicArmDriver(None, profile, MemoryTopics())


def test_a_gripper_goes_to_both_ends_of_its_own_computation():
    profile = offset_profile()
    assert profile.gripper is not None
    arm = driver(profile)
    arm.open()
    for opening in (0.0, 1.0):
        position = np.array([profile.gripper.to_position(opening)])
        arm.send(JointCommand(names=("finger",), position=position, duration_s=0.1))


def test_a_joint_beyond_its_limits_is_refused():
    arm = driver(gantry_profile())
    arm.open()
    with pytest.raises(InvalidInputError):
        arm.send(JointCommand(names=("slide_x",), position=np.array([1.001]), duration_s=1.0))


def test_a_duration_is_told_that_velocity_and_acceleration_allow():
    arm = driver(gantry_profile())
    arm.open()
    sent = arm.send(JointCommand(names=("slide_x",), position=np.array([0.9]), duration_s=0.1))
    assert sent.duration_s == pytest.approx(0.8 / 1.0 + 1.0 / 5.0)  # 0.1 .. 0.9 at 1 m/s, 5 m/s^2


def test_a_driver_that_is_closed_answers_no_more():
    arm = driver(gantry_profile())
    arm.open()
    arm.close()
    with pytest.raises(StateError):
        arm.read()


@pytest.mark.parametrize("lacking", ["home_rad", "limits"])
def test_a_profile_without_home_or_limits_is_refused(lacking):
    with pytest.raises(ConfigurationError):
        driver(replace(gantry_profile(), **{lacking: None})).open()
