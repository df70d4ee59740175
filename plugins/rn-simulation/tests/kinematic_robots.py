"""A robot whose joints and gripper are of every kind, moved by the driver without physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rn_testing.fakes import FAKE_ROBOT, gantry_profile
from roboneuron import DriverSpec, GripperProfile, RobotProfile, RobotSpec

DRIVER = DriverSpec(
    name="simulated",
    summary="Moves within the joints' limits, without physics.",
    target="rn_simulation.kinematic_driver:KinematicArmDriver",
    simulated=True,
)


def with_profile(name: str) -> RobotSpec:
    """The fake robot with this driver and the profile of a function of this module."""
    return replace(FAKE_ROBOT, target=f"kinematic_robots:{name}", drivers=(DRIVER,))


def endless_profile() -> RobotProfile:
    """Slides, hinges, one of which turns without end, and a finger."""
    profile = gantry_profile()
    assert profile.limits is not None
    urdf = profile.urdf.replace('name="roll" type="revolute"', 'name="roll" type="continuous"')
    lower, upper = profile.limits.lower.copy(), profile.limits.upper.copy()
    lower[-1], upper[-1] = -np.inf, np.inf
    return replace(profile, urdf=urdf, limits=replace(profile.limits, lower=lower, upper=upper))


def offset_profile() -> RobotProfile:
    """Its finger is closed at a position that is no round number, and open at the lower one."""
    gripper = GripperProfile(joint="finger", closed_position=0.037, open_position=0.011)
    return replace(gantry_profile(), gripper=gripper)


def bare_profile() -> RobotProfile:
    """It has no gripper."""
    return replace(gantry_profile(), gripper=None)
