"""Limits of the joints on position and velocity (also position-dependent); see `acceleration` for
the changes of velocity.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

from roboneuron.contract import F64, RobotProfile, nearest_turn
from roboneuron.gate.motion.rules import MotionRules

_SLACK = 1e-6
"""Relative tolerance on a limit for rounding."""
_NOTHING = 1e-9
"""Displacement below which a motion is rounding [rad or m]."""


def braking_velocity(
    distance: float, offset: float, deceleration: float, step_s: float = 0.0
) -> float:
    """Fastest velocity towards a limit at `distance`, kept for `step_s` and braked afterwards.

    v <= -offset + sqrt(2 * deceleration * (distance - v * step_s)), solved for v; never negative.

    Args:
        distance: distance to the limit [rad or m].
        offset: velocity kept in reserve [per s].
        deceleration: of the joint's braking [per s^2], > 0.
        step_s: time before the velocity can change [s]; 0 for the bound at this position.

    Source: libfranka rate_limiting.h for step_s = 0.
    """
    reserve = offset + deceleration * step_s
    return max(
        0.0,
        math.sqrt(max(0.0, reserve * reserve - offset * offset + 2.0 * deceleration * distance))
        - reserve,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class JointLimit:
    """Limits of one joint in rad or m, per s, per s^2, and Nm or N; infinite if the profile has
    none.

    Attributes:
        braking: offset and deceleration of a joint that slows down near a position limit; None for
            others.
        is_continuous: whole turns do not change its posture.
        SLACK: relative tolerance on a limit for rounding.
    """

    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf
    acceleration: float = math.inf
    effort: float = math.inf
    braking: tuple[float, float] | None = None
    is_continuous: bool = False
    SLACK: ClassVar = _SLACK

    @classmethod
    def by_joint(
        cls, profile: RobotProfile, rules: MotionRules | None = None
    ) -> dict[str, JointLimit]:
        """Limits by joint name: those of the arms, scaled by the fractions of `rules`, and the
        grippers' travel.
        """
        found: dict[str, JointLimit] = {}
        rules = rules or MotionRules(reactions={})
        limits = profile.limits
        for i, name in enumerate(profile.arm_joints if limits is not None else ()):
            assert limits is not None
            braking = None
            if limits.braking_offset is not None and limits.braking_deceleration is not None:
                braking = float(limits.braking_offset[i]), float(limits.braking_deceleration[i])
            found[name] = cls(
                lower=float(limits.lower[i]),
                upper=float(limits.upper[i]),
                velocity=float(limits.velocity[i]) * rules.velocity_fraction,
                acceleration=float(limits.acceleration[i]) * rules.acceleration_fraction,
                effort=float(limits.effort[i]),
                braking=braking,
                is_continuous=name in profile.kinds.continuous,
            )
        for gripper in profile.grippers:
            low, high = sorted((gripper.closed_position, gripper.open_position))
            found[gripper.joint] = cls(lower=low, upper=high)
        return found

    def allows(self, quantity: str, value: float) -> bool:
        """Return True if a "position", "velocity", "acceleration" or "effort" is within its limits;
        False for NaN and infinity.
        """
        low, high = self.range(quantity)
        return math.isfinite(value) and low - _SLACK * max(
            1.0, abs(low)
        ) <= value <= high + _SLACK * max(1.0, abs(high))

    def nearest(self, start: float, goal: float) -> float:
        """`goal` as the joint at `start` reaches it soonest within its limits [rad or m]: for a
        continuous joint with whole turns added.
        """
        return nearest_turn(start, goal, self.lower, self.upper) if self.is_continuous else goal

    def range(self, quantity: str) -> tuple[float, float]:
        """Lowest and highest value of a quantity; all but positions are symmetric."""
        if quantity == "position":
            return self.lower, self.upper
        high: float = getattr(self, quantity)
        return -high, high

    def fastest(self, position: float, towards_upper: bool, kept_s: float = 0.0) -> float:
        """Fastest velocity >= 0 at a position towards one of the limits, if kept for `kept_s`.

        For a whole step use its start and duration; to check the end of a step use its end position
        and 0.
        """
        if self.braking is None:
            return self.velocity
        distance = self.upper - position if towards_upper else position - self.lower
        offset, deceleration = self.braking
        if kept_s:  # after the step the joint brakes by commands, whose acceleration is limited too
            deceleration = min(deceleration, self.acceleration)
        return min(self.velocity, braking_velocity(distance, offset, deceleration, kept_s))


class JointSpace:
    """Limits of n arm joints on the place and the velocity of each command; stateless. Arrays are
    float64 (n,).

    Plain floats are used inside: for seven joints a loop over them is faster than numpy calls.
    """

    def __init__(self, names: Sequence[str], limits: Sequence[JointLimit]) -> None:
        self._names, self._limits = names, limits

    def violations(
        self, start: F64, change: F64, step_s: float
    ) -> Iterator[tuple[str, float, str]]:
        """Limits of position and velocity that `change` in `step_s` violates: name, allowed
        fraction, reason.

        A joint that starts outside of its position limits may move towards them by any
        displacement.
        """
        position, velocity = (1.0, ""), (1.0, "")
        for name, limit, begin, displacement in zip(
            self._names, self._limits, start.tolist(), change.tolist(), strict=True
        ):
            length = abs(displacement)
            if length == 0.0:
                continue
            remaining = limit.upper - begin if displacement > 0.0 else begin - limit.lower
            bound = limit.upper if displacement > 0.0 else limit.lower
            if length - remaining > _SLACK * max(1.0, abs(bound)):
                share = max(0.0, remaining / length)
                if share < position[0]:
                    end = begin + displacement
                    position = share, f"{name} would go to {end:.4f}, beyond its limits."
            # at the start of the step: a joint that brakes towards its limit is slower at its end,
            # which `braking_velocity` takes into account
            share = limit.fastest(begin, displacement > 0.0, step_s) * step_s / length
            if length > _NOTHING and share < velocity[0] * (1.0 - _SLACK):
                speed = length / step_s
                velocity = (
                    share,
                    f"{name} would move at {speed:.4g} per second, allowed is {speed * share:.4g}.",
                )
        for quantity, (share, reason) in (("position", position), ("velocity", velocity)):
            if reason:
                yield quantity, share, reason
