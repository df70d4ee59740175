"""Limits of single joints, as the profile of a robot and the configuration give them."""

from __future__ import annotations

from dataclasses import dataclass

from roboneuron.contract import RobotProfile
from roboneuron.gate.motion.joint_space import braking_velocity
from roboneuron.gate.motion.rules import MotionRules


@dataclass(frozen=True, kw_only=True, slots=True)
class JointLimit:
    """Limits of one joint in rad or m, per s, per s^2, and Nm or N; infinite where the profile has none.

    Attributes:
        braking: offset and deceleration of a joint that is slower near a position limit; None for others.
    """

    lower: float
    upper: float
    velocity: float
    acceleration: float
    effort: float
    braking: tuple[float, float] | None = None

    def fastest(self, start: float, end: float) -> float:
        """Fastest velocity of a step from `start` to `end`, so that the joint can brake before its limit after it."""
        if self.braking is None:
            return self.velocity
        return min(
            self.velocity, braking_velocity(self.upper - end if end > start else end - self.lower, *self.braking)
        )


def joint_limits(profile: RobotProfile, rules: MotionRules | None = None) -> dict[str, JointLimit]:
    """Limits by joint name: the arm's, in the shares that `rules` allow, and the gripper's travel."""
    found: dict[str, JointLimit] = {}
    velocity, acceleration = (rules.velocity_fraction, rules.acceleration_fraction) if rules is not None else (1.0, 1.0)
    if profile.limits is not None:
        arrays = profile.limits
        for i, name in enumerate(profile.arm_joints):
            found[name] = JointLimit(
                lower=float(arrays.lower[i]),
                upper=float(arrays.upper[i]),
                velocity=float(arrays.velocity[i]) * velocity,
                acceleration=float(arrays.acceleration[i]) * acceleration,
                effort=float(arrays.effort[i]),
                braking=None
                if arrays.braking_offset is None or arrays.braking_deceleration is None
                else (float(arrays.braking_offset[i]), float(arrays.braking_deceleration[i])),
            )
    if profile.gripper is not None:
        ends = sorted((profile.gripper.closed_position, profile.gripper.open_position))
        free = float("inf")
        found[profile.gripper.joint] = JointLimit(
            lower=ends[0], upper=ends[1], velocity=free, acceleration=free, effort=free
        )
    return found
