"""Inputs for controllers, and checks of their commands against the profile's limits and the
URDF.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rn_testing.kinematics import place_tcp
from rn_testing.rule import Violation, require
from roboneuron import (
    F64,
    Action,
    JointCommand,
    JointSample,
    Pose,
    RobotProfile,
    apply_delta,
    matrix_from_quaternion,
    rotvec_from_matrix,
)

TRUTH_M, TRUTH_RAD = 1e-5, 1e-4
"""Tolerance between the end of a command and its residual, for rounding: the residual itself is
compared. Below what solvers leave that stop at a tolerance, so that a residual of 0 is noticed.
"""


def home_sample(profile: RobotProfile) -> JointSample:
    """Joint sample of `profile` at home, with an open gripper."""
    if profile.home_rad is None or profile.limits is None:
        raise Violation("the case's profile has no home posture or no limits")
    return arm_sample(profile, profile.home_rad)


def arm_sample(profile: RobotProfile, position: F64) -> JointSample:
    """Joint sample of arm joints (n,), with an open gripper."""
    names = profile.arm_joints
    if profile.gripper is not None:
        names, position = (
            (*names, profile.gripper.joint),
            np.append(position, profile.gripper.open_position),
        )
    return JointSample(names=names, position=position, velocity=np.zeros(len(names)), stamp_ns=1)


def make_action(*values: float, opening: float = 1.0) -> Action:
    """Action from its first values; the others are 0."""
    padded = np.zeros(7)
    padded[: len(values)] = values
    padded[6] = opening
    return Action.from_vector(padded)


def by_name(sample: JointSample | JointCommand) -> dict[str, float]:
    """Position by joint name."""
    return dict(zip(sample.names, sample.position.tolist(), strict=True))


def check_command(
    command: JointCommand, start: JointSample, profile: RobotProfile, step_s: float
) -> None:
    """Check names, sizes, finiteness, limits, duration and speed."""
    known = set(profile.arm_joints) | ({profile.gripper.joint} if profile.gripper else set())
    foreign = [n for n in command.names if n not in known]
    require(not foreign, f"a command names joints that the profile lacks: {', '.join(foreign)}")
    require(len(set(command.names)) == len(command.names), "a command names a joint twice")
    require(
        command.position.shape == (len(command.names),),
        f"a command has positions {command.position.shape}",
    )
    require(
        bool(np.isfinite(command.position).all()), "a command holds a position that is not finite"
    )
    residuals = (command.residual_m, command.residual_rad)
    require(
        all(np.isfinite(r) and r >= 0 for r in residuals), f"a command has residuals {residuals}"
    )
    duration_s = command.duration_s
    require(
        duration_s >= 0.999 * step_s, f"a command for a step of {step_s:g} s lasts {duration_s:g} s"
    )
    limits = profile.limits
    assert limits is not None
    sent, measured = by_name(command), by_name(start)
    share = 0.0
    bounds = zip(
        profile.arm_joints,
        *(v.tolist() for v in (limits.lower, limits.upper, limits.velocity)),
        strict=True,
    )
    for name, low, high, velocity in bounds:
        if name not in sent:
            continue
        require(
            low - 1e-9 <= sent[name] <= high + 1e-9,
            f"{name} is sent to {sent[name]:.4f}, its limits are {low:g} .. {high:g}",
        )
        share = max(share, abs(sent[name] - measured[name]) / (velocity * duration_s))
    require(share <= 1.01, f"a command needs {share:.1f} times the velocity limit of a joint")
    is_stretched = duration_s > 1.001 * step_s
    require(
        not is_stretched or share > 0.1, f"a small step of {step_s:g} s is given {duration_s:g} s"
    )


def distance(a: Pose, b: Pose) -> tuple[float, float]:
    """Distance of two poses [m], [rad]."""
    turn = matrix_from_quaternion(a.quaternion_xyzw).T @ matrix_from_quaternion(b.quaternion_xyzw)
    return float(np.linalg.norm(a.position_m - b.position_m)), float(
        np.linalg.norm(rotvec_from_matrix(turn))
    )


def check_arrives(
    command: JointCommand, action: Action, joints: JointSample, profile: RobotProfile
) -> None:
    """Check with the URDF that the command ends where its residual says."""
    start = by_name(joints)
    reached = place_tcp(profile, {**start, **by_name(command)})
    error_m, error_rad = distance(reached, apply_delta(place_tcp(profile, start), action))
    require(
        error_m <= command.residual_m + TRUTH_M and error_rad <= command.residual_rad + TRUTH_RAD,
        f"an action of {action.to_vector()[:6]} ends {error_m:.5f} m and {error_rad:.4f} rad from "
        "its target, "
        f"the command says {command.residual_m:.5f} m and {command.residual_rad:.4f} rad",
    )


def postures(profile: RobotProfile) -> Iterator[JointSample]:
    """Home, and home with every joint slightly displaced, well within the limits."""
    home = home_sample(profile)
    limits, arm = profile.limits, home.position[: len(profile.arm_joints)]
    assert limits is not None
    inner = np.minimum(0.2 * (limits.upper - limits.lower), 0.1)
    signs = np.where(np.arange(len(arm)) % 2, 1.0, -1.0)
    yield home
    for turn in (0.15, -0.15):
        moved = np.clip(
            arm + turn * signs,
            limits.lower + inner,
            limits.upper - inner,
        )
        yield arm_sample(profile, moved)
