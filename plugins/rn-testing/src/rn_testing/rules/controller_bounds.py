"""Rules of controllers on bounds: unreachable targets, joint and velocity limits, and computing
time.
"""

from __future__ import annotations

import numpy as np

from rn_testing.cases import ControllerCase
from rn_testing.commands import (
    arm_sample,
    by_name,
    check_arrives,
    check_command,
    home_sample,
    make_action,
)
from rn_testing.effects import check_quick
from rn_testing.kinematics import read_chain
from rn_testing.rule import Rule, require
from rn_testing.rules.controller import (
    RESIDUAL_M,
    RESIDUAL_RAD,
    STEP_S,
    compute,
    controller_rule,
    loaded,
)
from roboneuron import Hold, JointCommand, RobotProfile

MAX_STEP = 0.3
"""Largest change of a joint by one action [rad or m]. Source: the project's rule that no step jumps
configuration.
"""
WALK_M, WALK_S = 0.05, 0.5
"""Steps towards the limit of the reach, and the time for each."""
COMPUTE_LIMIT_S = 0.05
"""Limit of the quickest of some `compute` calls: half of the time between two actions."""


def _check_far(case: ControllerCase) -> None:
    profile = case.robot()
    with loaded(case) as controller:
        for values in ((5.0,), (0, 0, -5.0), (0, -2.0), (0, 0, 0, 3.0, 0, 0)):
            joints, action = home_sample(profile), make_action(*values)
            result = compute(controller, action, joints)
            if isinstance(result, Hold):
                continue
            require(not any(values[:3]), f"a target {values} m away was not refused")
            check_command(result, joints, profile, STEP_S)
            check_arrives(result, action, joints, profile)
            step = max(
                abs(p - by_name(joints)[n])
                for n, p in by_name(result).items()
                if n in profile.arm_joints
            )
            require(
                step <= MAX_STEP, f"an action of {values} moves a joint by {step:.2f} in {STEP_S} s"
            )


def _check_limits(case: ControllerCase) -> None:
    """With one joint at its limit, steps in every direction must respect the limits and have a
    correct residual.
    """
    profile = case.robot()
    home = home_sample(profile)
    limits, count = profile.limits, len(profile.arm_joints)
    assert limits is not None
    with loaded(case) as controller:
        for joint in range(count):
            for bound, inward in ((limits.lower[joint], 1e-4), (limits.upper[joint], -1e-4)):
                arm = home.position[:count].copy()
                if not np.isfinite(bound):  # it turns without end
                    continue
                arm[joint] = bound + inward
                joints = arm_sample(profile, arm)
                for axis in range(6):
                    for sign in (1, -1):
                        action = make_action(
                            *(sign * (0.01 if axis < 3 else 0.03) * np.eye(6)[axis])
                        )
                        result = compute(controller, action, joints)
                        if isinstance(result, JointCommand):
                            check_command(result, joints, profile, STEP_S)
                            check_arrives(result, action, joints, profile)


def _reach_m(profile: RobotProfile) -> float:
    """Upper bound on the distance of the TCP from the base, from the URDF."""
    chain = read_chain(profile)
    slides = sum(profile.kinds.farthest(joint.name) for joint in chain if joint.kind == "prismatic")
    return sum(float(np.linalg.norm(joint.origin[:3, 3])) for joint in chain) + slides


def _check_reach(case: ControllerCase) -> None:
    """Move in steps to the limit of the reach and beyond: commands may be refused, but must not
    have a wrong residual.
    """
    profile = case.robot()
    names, far_m = profile.arm_joints, 2 * _reach_m(profile)
    with loaded(case) as controller:
        for axis in range(3):
            for sign in (1, -1):
                joints, walked_m = home_sample(profile), 0.0
                action = make_action(*(sign * WALK_M * np.eye(6)[axis]))
                while walked_m <= far_m:
                    result = compute(controller, action, joints, WALK_S)
                    if isinstance(result, Hold):
                        break
                    check_command(result, joints, profile, WALK_S)
                    check_arrives(result, action, joints, profile)
                    short = (
                        f"a target is missed by {result.residual_m:.4f} m, "
                        f"{result.residual_rad:.4f} rad"
                    )
                    good = result.residual_m <= RESIDUAL_M and result.residual_rad <= RESIDUAL_RAD
                    require(good, f"{short} and not refused")
                    reached = {**by_name(joints), **by_name(result)}
                    joints = arm_sample(profile, np.array([reached[name] for name in names]))
                    walked_m += WALK_M
                require(
                    walked_m <= far_m,
                    f"a target {walked_m:.1f} m away, beyond the reach, was not refused",
                )


def _check_fast(case: ControllerCase) -> None:
    profile = case.robot()
    joints = home_sample(profile)
    with loaded(case) as controller:
        for axis in range(6):
            action, step_s = make_action(*(0.1 * np.eye(6)[axis])), 0.01
            result = compute(controller, action, joints, step_s)
            if isinstance(result, JointCommand):
                check_command(result, joints, profile, step_s)


def _check_quick(case: ControllerCase) -> None:
    joints = home_sample(case.robot())
    with loaded(case) as controller:
        check_quick(
            COMPUTE_LIMIT_S,
            lambda: controller.compute(make_action(0.002), joints, STEP_S),
            "compute",
            tries=7,
        )
        check_quick(COMPUTE_LIMIT_S, lambda: controller.forward(joints), "forward", tries=7)


RULES: tuple[Rule[ControllerCase], ...] = (
    controller_rule(
        "far-targets-harmless",
        "A target metres away is refused; a large turn is, or stays within the limits and 0.3 rad "
        "per joint.",
        _check_far,
    ),
    controller_rule(
        "reach-kept",
        "On the way out of reach every command ends where its residual says, and what cannot be "
        "reached is refused.",
        _check_reach,
    ),
    controller_rule(
        "limits-kept",
        "Near a joint limit no command exceeds the limit, and its residual is correct.",
        _check_limits,
    ),
    controller_rule(
        "velocity-kept",
        "A step too fast for the joints' velocity limits is refused or given more time.",
        _check_fast,
        "roboneuron.contract.profile.JointLimits",
    ),
    controller_rule(
        "compute-quick", "`compute` and `forward` take a fraction of a step.", _check_quick
    ),
)
"""Rules of controllers on bounds."""
