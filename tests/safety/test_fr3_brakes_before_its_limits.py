"""The FR3's position-dependent velocity limits, as defined in its package and applied by core on
both paths.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.limits import ARM_JOINTS, joint_limits, velocity_bounds
from rn_robot_fr3.profile import profile
from roboneuron.config import LimitsConfig
from roboneuron.contract import JointCommand, JointSample, PostureInspector
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import MotionLimiter, motion_rules
from roboneuron.gate.motion.joint_paths import check_joints
from roboneuron.gate.motion.joint_space import JointLimit, braking_velocity


def test_core_brakes_as_the_official_formula_does() -> None:
    limits = joint_limits()
    assert limits.braking_offset is not None
    assert limits.braking_deceleration is not None
    for position in np.random.default_rng(5).uniform(limits.lower, limits.upper, (200, 7)):
        lowest, highest = velocity_bounds(position)
        for i in range(7):
            brake = float(limits.braking_offset[i]), float(limits.braking_deceleration[i])
            fastest = float(limits.velocity[i])
            up = min(fastest, braking_velocity(float(limits.upper[i] - position[i]), *brake))
            down = min(fastest, braking_velocity(float(position[i] - limits.lower[i]), *brake))
            assert (up, -down) == pytest.approx((highest[i], lowest[i]), abs=1e-9)


def test_steps_towards_a_limit_become_slower_and_never_pass_it() -> None:
    """Joint 2 is requested to advance by 0.2 rad, 30 times a second, for five seconds; the arm
    follows exactly.
    """
    robot = replace(profile(), collision=None)  # the table would stop it before its limits do
    controller = UrdfController(None, robot)
    controller.load()
    assert isinstance(controller, PostureInspector)
    free = LimitsConfig(max_step_m=1.0, max_step_rad=3.0, max_speed_m_s=3.0, max_turn_rad_s=10.0)
    rules = motion_rules(
        free.model_copy(update={"on_position": "scale", "on_workspace": "scale"}), robot
    )
    rules = type(rules)(reactions=rules.reactions)  # only the joint limits
    limiter = MotionLimiter(rules, robot, controller.forward, controller.inspect)
    position, speeds = robot.home_rad.copy(), []
    limit = JointLimit.by_joint(robot)[ARM_JOINTS[1]]
    assert robot.limits is not None
    for step in range(150):
        asked = position.copy()
        asked[1] += 0.2
        sample = JointSample(names=ARM_JOINTS, position=position)
        verdict = limiter.limit(
            JointCommand(names=ARM_JOINTS, position=asked, duration_s=1 / 30), sample, step / 30
        )
        assert isinstance(verdict.command, JointCommand), verdict.reason
        speed = (verdict.command.position[1] - position[1]) * 30
        # 1e-12 rad/s: positions of 1 rad are rounded to 1e-16
        assert speed <= limit.fastest(float(position[1]), True, 1 / 30) * (1 + 1e-5) + 1e-12
        assert speed <= velocity_bounds(verdict.command.position)[1][1] + 1e-5
        position = verdict.command.position
        speeds.append(speed)
    assert max(speeds) > 1.5
    assert speeds[-1] < 0.01
    assert robot.limits.upper[1] - 0.02 < position[1] < robot.limits.upper[1]


def test_direct_trajectories_are_held_to_the_same_bound() -> None:
    robot = profile()
    limits = JointLimit.by_joint(robot)
    start = JointSample(names=ARM_JOINTS, position=robot.home_rad)

    def message(target: float, seconds: int) -> SimpleNamespace:
        positions = robot.home_rad.copy()
        positions[1] = target
        point = SimpleNamespace(
            positions=positions.tolist(),
            velocities=[],
            accelerations=[],
            effort=[],
            time_from_start=SimpleNamespace(sec=seconds, nanosec=0),
        )
        return SimpleNamespace(joint_names=list(ARM_JOINTS), points=[point])

    check_joints(limits, [message(1.0, 1)], start)
    check_joints(limits, [message(1.76, 20)], start)
    with pytest.raises(RefusedError, match="so near to its limit"):
        check_joints(limits, [message(1.76, 2)], start)
    with pytest.raises(RefusedError, match="farther from the limit"):
        check_joints(limits, [message(1.7836, 100)], start)
