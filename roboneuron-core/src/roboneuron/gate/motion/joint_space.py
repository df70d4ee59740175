"""Limits of the joints: position, velocity (also where it depends on position), acceleration."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import JointLimits

F64 = NDArray[np.float64]

SLACK = 1e-6
"""Relative: what rounding and decimals on the way may add to a limit."""
_NOTHING = 1e-9
"""A way this short [rad or m] is rounding, not motion."""


def braking_velocity(distance: float, offset: float, deceleration: float, step_s: float = 0.0) -> float:
    """Fastest velocity towards a limit that lies `distance` away, kept for `step_s` and braked after it.

    v <= -offset + sqrt(2 * deceleration * (distance - v * step_s)), solved for v; never negative.

    Args:
        distance: to the limit [rad or m].
        offset: velocity kept in reserve [per s].
        deceleration: with which the joint brakes [per s^2], > 0.
        step_s: how long the velocity lasts before it can change [s]; 0 for the bound at this very position.

    Source: libfranka rate_limiting.h for step_s = 0.
    """
    reach = offset + deceleration * step_s
    return max(0.0, math.sqrt(max(0.0, reach * reach - offset * offset + 2.0 * deceleration * distance)) - reach)


class JointSpace:
    """The limits of n arm joints in use; stateless. Arrays are float64 (n,) in the order of the profile's arm joints.

    Plain floats inside: for seven joints a loop over them is faster than the calls into numpy.
    """

    def __init__(self, limits: JointLimits | None, joints: int, *, velocity: float = 1.0, acceleration: float = 1.0):
        """Args:
        limits: the profile's; None for no limits.
        joints: n.
        velocity, acceleration: share of these limits in use.
        """
        free = [math.inf] * joints
        self.lower = [-math.inf] * joints if limits is None else limits.lower.tolist()
        self.upper = free if limits is None else limits.upper.tolist()
        self.velocity = free if limits is None else (limits.velocity * velocity).tolist()
        self.acceleration = free if limits is None else (limits.acceleration * acceleration).tolist()
        self._braking: list[tuple[float, float]] | None = None
        if limits is not None and limits.braking_offset is not None and limits.braking_deceleration is not None:
            # A deceleration above the acceleration limit is not to be had.
            deceleration = np.minimum(limits.braking_deceleration, limits.acceleration * acceleration)
            self._braking = list(zip(limits.braking_offset.tolist(), deceleration.tolist(), strict=True))

    def fastest(self, joint: int, start: float, towards_upper: bool, step_s: float) -> float:
        """Fastest velocity >= 0 of a joint that leaves `start` towards one of its limits and goes on for `step_s`."""
        if self._braking is None:
            return self.velocity[joint]
        distance = self.upper[joint] - start if towards_upper else start - self.lower[joint]
        return min(self.velocity[joint], braking_velocity(distance, *self._braking[joint], step_s))

    def position_share(self, start: F64, change: F64) -> tuple[float, int]:
        """Largest share of `change` that stays within the positions, and the joint that sets it.

        A joint that starts outside may move back in, and any way towards it.
        """
        share, joint = 1.0, -1
        for i, (begin, way) in enumerate(zip(start.tolist(), change.tolist(), strict=True)):
            end = begin + way
            limit = self.upper[i] if way > 0.0 else self.lower[i]
            beyond = end - limit if way > 0.0 else limit - end
            if way != 0.0 and beyond > SLACK * max(1.0, abs(limit)):
                possible = max(0.0, (limit - begin) / way)
                if possible < share:
                    share, joint = possible, i
        return share, joint

    def velocity_share(self, start: F64, change: F64, step_s: float) -> tuple[float, int]:
        """Largest share of `change` that every joint can go in `step_s`, and the joint that sets it."""
        share, joint = 1.0, -1
        for i, (begin, way) in enumerate(zip(start.tolist(), change.tolist(), strict=True)):
            if abs(way) <= _NOTHING:
                continue
            possible = self.fastest(i, begin, way > 0.0, step_s) * step_s / abs(way)
            if possible < share * (1.0 - SLACK):
                share, joint = possible, i
        return share, joint

    def reach(self, before: F64, wanted: F64, passed_s: float) -> tuple[F64, int]:
        """The velocity nearest to `wanted` that the joints can have `passed_s` after `before`, and the limiting joint.

        It is a share of `wanted`, so that the direction is kept, whenever such a share is within reach. When the arm
        is too fast to turn or stop at once, it is the velocity on the way from `before` to `wanted` that is.

        Returns:
            Velocity, and -1 when it is `wanted` itself.
        """
        if self.is_reachable(before, wanted, passed_s):
            return wanted, -1
        least, most, joint = 0.0, 1.0, 0
        for i, (old, new) in enumerate(zip(before.tolist(), wanted.tolist(), strict=True)):
            room = self.acceleration[i] * passed_s
            if new == 0.0:
                least = math.inf if abs(old) > room else least
                continue
            low, high = sorted(((old - room) / new, (old + room) / new))
            least = max(least, low)
            if high < most:
                most, joint = high, i
        if least <= most:
            return wanted * most, joint
        change = (wanted - before).tolist()
        parts = [self.acceleration[i] * passed_s / abs(c) if c else math.inf for i, c in enumerate(change)]
        part = min(parts)
        return before + (wanted - before) * min(1.0, part), parts.index(part)

    def is_reachable(self, before: F64, velocity: F64, passed_s: float) -> bool:
        """Whether the joints can have `velocity` so soon after `before`."""
        return all(
            abs(new - old) <= self.acceleration[i] * passed_s * (1.0 + 2 * SLACK) + 1e-12
            for i, (old, new) in enumerate(zip(before.tolist(), velocity.tolist(), strict=True))
        )
