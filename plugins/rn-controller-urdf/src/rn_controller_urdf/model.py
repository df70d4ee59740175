"""Arm model for the solver: pinocchio model of the chain, limits, and the map from arm joints to
chain joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rn_controller_urdf.chain import ChainJoint, kinematic_urdf, parse_chain
from roboneuron import ConfigurationError, MimicJoint, RobotProfile

if TYPE_CHECKING:
    import pinocchio

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ArmModel:
    """A chain of n arm joints, m >= n moving chain joints (the difference mimics arm joints) and
    one TCP frame.

    Attributes:
        joints: arm joint names, base to tip.
        prismatic: bool (n,), True for positions in metres.
        lower, upper, velocity: float64 (n,) [rad or m, per second for velocity].
        coupling: (gain, offset), float64 (m, n) and (m,): chain positions = gain @ arm positions +
            offset; None when no joint mimics another.
        kinematics: pinocchio.Model of the chain, rooted at the base link.
        tcp_frame: index of the TCP frame in it.
    """

    joints: tuple[str, ...]
    prismatic: NDArray[np.bool_]
    lower: F64
    upper: F64
    velocity: F64
    coupling: tuple[F64, F64] | None
    kinematics: pinocchio.Model
    tcp_frame: int


def _arm_joints(profile: RobotProfile, moving: list[ChainJoint]) -> list[ChainJoint]:
    """Joints commanded by the profile, in chain order; every other moving joint must mimic one of
    them.
    """
    arm = [joint for joint in moving if joint.name in profile.arm_joints]
    missing = set(profile.arm_joints) - {joint.name for joint in arm}
    if missing or not arm:
        raise ConfigurationError(
            f"Robot {profile.name!r}: arm joints {sorted(missing) or '(none given)'} do not move "
            f"{profile.tcp_link!r} "
            f"against {profile.base_link!r}; the joints between them are "
            f"{[joint.name for joint in moving]}."
        )
    leaders = {f.name: f.leader for f in _followers(profile, moving)}
    for joint in moving:
        if joint in arm:
            if joint.name in leaders:
                raise ConfigurationError(
                    f"Robot {profile.name!r}: arm joint {joint.name!r} mimics "
                    f"{leaders[joint.name]!r} and cannot be "
                    "commanded.",
                    hint="Take it out of arm_joints.",
                )
        elif leaders.get(joint.name) not in profile.arm_joints:
            raise ConfigurationError(
                f"Robot {profile.name!r}: joint {joint.name!r} lies between {profile.base_link!r} "
                "and "
                f"{profile.tcp_link!r} but is neither an arm joint nor mimics one.",
                hint="Add it to arm_joints, or make it fixed in the URDF.",
            )
    return arm


def _limits(profile: RobotProfile, arm: list[ChainJoint]) -> tuple[F64, F64, F64]:
    """The profile's limits in chain order, or the URDF's if the profile has none."""
    if profile.limits is None:
        lower = np.array([joint.lower for joint in arm])
        upper = np.array([joint.upper for joint in arm])
        velocity = np.array([joint.velocity for joint in arm])
    else:
        order = [profile.arm_joints.index(joint.name) for joint in arm]
        arrays = [
            np.asarray(a, dtype=np.float64) for a in (profile.limits.lower, profile.limits.upper)
        ]
        arrays.append(np.asarray(profile.limits.velocity, dtype=np.float64))
        if any(a.shape != (len(arm),) for a in arrays):
            raise ConfigurationError(
                f"Robot {profile.name!r}: its limits have shapes {[a.shape for a in arrays]}, "
                f"expected ({len(arm)},) for {len(arm)} arm joints."
            )
        lower, upper, velocity = (a[order] for a in arrays)
    for i, joint in enumerate(arm):
        if not (lower[i] < upper[i] and velocity[i] > 0):
            raise ConfigurationError(
                f"Robot {profile.name!r}: joint {joint.name!r} has limits "
                f"{lower[i]:g}..{upper[i]:g} and velocity "
                f"{velocity[i]:g}, expected lower < upper and a velocity > 0."
            )
        if joint.is_prismatic and not (np.isfinite(lower[i]) and np.isfinite(upper[i])):
            raise ConfigurationError(
                f"Robot {profile.name!r}: prismatic joint {joint.name!r} has no position limits."
            )
    return lower, upper, velocity


def _followers(profile: RobotProfile, moving: list[ChainJoint]) -> list[MimicJoint]:
    """Those of the chain; others are not looked at without need."""
    if not any(joint.is_follower for joint in moving):
        return []
    names = {joint.name for joint in moving}
    return [follower for follower in profile.kinds.followers if follower.name in names]


def _coupling(
    profile: RobotProfile, moving: list[ChainJoint], arm: list[ChainJoint]
) -> tuple[F64, F64]:
    rows = {joint.name: row for row, joint in enumerate(moving)}
    columns = {joint.name: column for column, joint in enumerate(arm)}
    gain, offset = np.zeros((len(moving), len(arm))), np.zeros(len(moving))
    for name, column in columns.items():
        gain[rows[name], column] = 1.0
    for follower in _followers(profile, moving):
        row = rows[follower.name]
        gain[row, columns[follower.leader]] = follower.multiplier
        offset[row] = follower.offset
    return gain, offset


def build_arm_model(profile: RobotProfile) -> ArmModel:
    """Build the arm of `profile` from its URDF.

    Raises:
        ConfigurationError: the URDF, the link names, the joint names or the limits do not form an
            arm; names which.
    """
    import pinocchio  # heavy

    chain = parse_chain(profile.urdf, profile.base_link, profile.tcp_link)
    moving = [joint for joint in chain if joint.is_moving]
    arm = _arm_joints(profile, moving)
    lower, upper, velocity = _limits(profile, arm)
    kinematics = pinocchio.buildModelFromXML(kinematic_urdf(chain))
    if kinematics.nq != len(moving):
        raise ConfigurationError(
            f"Robot {profile.name!r}: its chain has {kinematics.nq} coordinates for {len(moving)} "
            "joints."
        )
    return ArmModel(
        joints=tuple(joint.name for joint in arm),
        prismatic=np.array([joint.is_prismatic for joint in arm]),
        lower=lower,
        upper=upper,
        velocity=velocity,
        coupling=_coupling(profile, moving, arm) if len(moving) > len(arm) else None,
        kinematics=kinematics,
        tcp_frame=int(kinematics.getFrameId(profile.tcp_link, pinocchio.FrameType.BODY)),
    )
