"""Maximum speed to a target, so that ruckig's motion stays inside the limits of the arm.

Pure computation. The follower interpolates with ruckig under constant limits; the FR3 accepts less
speed near a joint's limit. Source of that envelope: see `rn_robot_fr3.limits.velocity_bounds`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_robot_fr3.limits import (
    BRAKING_DECELERATION_RAD_S2,
    BRAKING_OFFSET_RAD_S,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RAD_S,
)

F64 = NDArray[np.float64]

VELOCITY_LIMIT_RAD_S = np.array([2.1, 2.1, 2.1, 2.1, 2.6, 2.6, 2.6])
"""Below the official table, so that an arm that extrapolates through a gap of 20 cycles also stays
below it.
"""
STOP_ACCELERATION_RAD_S2 = np.full(7, 9.0)
"""Deceleration of a stop. The margin to the official 10 rad/s^2 is for states, whose 32-bit floats
may be off by 0.5 rad/s^2.
"""
ACCELERATION_LIMIT_RAD_S2 = np.full(7, 7.4)
"""Acceleration of motions."""
JERK_LIMIT_RAD_S3 = np.full(7, 1800.0)
"""The official limit is 5000 rad/s^3; the rounding of a state counts as up to 1000 of it."""

_SLOWEST_RAD_S = 0.1
_LEAST_FACTOR = 0.01
"""Minimum velocity factor, for very long motions."""
_BRAKING_SHARE = 0.6
"""Share of the acceleration used for braking in the envelope."""
_AWAY = np.linspace(0.0, 1.5, 751)
_DECELERATION = np.minimum(
    np.array(BRAKING_DECELERATION_RAD_S2), _BRAKING_SHARE * ACCELERATION_LIMIT_RAD_S2
)
_OFFSET = np.array(BRAKING_OFFSET_RAD_S)
MARGIN_RAD = (_OFFSET + 1.5 * _SLOWEST_RAD_S) ** 2 / (2.0 * _DECELERATION)
"""Minimum distance of a target from a joint's limit; closer, the envelope leaves no speed for the
arrival.
"""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ArmPlan:
    """A planned motion to a target.

    Attributes:
        target: float64 (7,), within the limits less `MARGIN_RAD` [rad].
        velocity_factor: allowed share of `VELOCITY_LIMIT_RAD_S`.
        duration_s: estimated time until rest at the target.
    """

    target: F64
    velocity_factor: float
    duration_s: float


def plan(position: F64, target: F64, duration_s: float, factor: float) -> ArmPlan:
    """Plan a motion from `position` (7,) to `target` (7,) [rad] in about `duration_s`, with
    `factor` of the limits.

    The duration becomes a bound on the speed. Given to ruckig as a minimum duration, it failed on
    18 of 43 targets that replaced a motion (error -111); without one on 0 of 64.
    """
    clamped = np.clip(target, np.array(LOWER_RAD) + MARGIN_RAD, np.array(UPPER_RAD) - MARGIN_RAD)
    distance = clamped - position
    room = np.where(distance >= 0.0, np.array(UPPER_RAD) - clamped, clamped - np.array(LOWER_RAD))
    acceleration = factor * ACCELERATION_LIMIT_RAD_S2
    allowed = fastest_towards(room, acceleration)
    moving = np.abs(distance) > 1e-6
    share = np.minimum(1.0, allowed / VELOCITY_LIMIT_RAD_S)
    length = np.abs(distance)
    # the speed with which a trapezoidal profile takes just duration_s; none if even a triangle
    # takes longer
    room_s2 = (acceleration * duration_s) ** 2 - 4.0 * acceleration * length
    unhurried = np.where(
        room_s2 > 0.0, (acceleration * duration_s - np.sqrt(np.maximum(room_s2, 0.0))) / 2.0, np.inf
    )
    wanted = float((unhurried / VELOCITY_LIMIT_RAD_S).max())
    velocity_factor = float(min(factor, share[moving].min(initial=1.0), max(wanted, _LEAST_FACTOR)))
    speed = velocity_factor * VELOCITY_LIMIT_RAD_S
    times = np.where(
        length * acceleration > speed**2,
        length / speed + speed / acceleration,
        2.0 * np.sqrt(length / acceleration),
    )
    ramps_s = acceleration / (factor * JERK_LIMIT_RAD_S3)
    return ArmPlan(
        target=clamped,
        velocity_factor=velocity_factor,
        duration_s=max(duration_s, float((times + ramps_s).max())),
    )


def fastest_towards(room: F64, acceleration: F64) -> F64:
    """Cruising speed (7,) [rad/s] with which a joint that brakes with `acceleration` to rest at
    `room` (7,) [rad] before its limit never exceeds the envelope.
    """
    away = _AWAY[:, None]
    envelope = np.sqrt(2.0 * _DECELERATION * (room + away)) - _OFFSET
    braking = np.sqrt(2.0 * acceleration * away)
    violated = braking > envelope
    violated[0] = envelope[0] <= 0.0
    first = np.where(violated.any(axis=0), violated.argmax(axis=0), len(_AWAY) - 1)
    speed: F64 = np.sqrt(2.0 * acceleration * _AWAY[np.maximum(first - 1, 0)])
    capped: F64 = np.clip(speed, _SLOWEST_RAD_S, np.array(VELOCITY_RAD_S))
    return capped
