"""How fast the arm may go to a target, so that ruckig's motion stays inside the limits of the arm.

Pure computation. libfranka's client interpolates with ruckig under constant limits; the FR3 accepts less speed near a
joint's limit. Source of that envelope: see `rn_robot_fr3.limits.velocity_bounds`. The limits of acceleration and jerk
leave room for what the client library does when a motion replaces another one, and when a cycle was missed.
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
"""Below the official table: what the client library (franky 2.0.0) allows at most is 2.175 and 2.61."""
STOP_ACCELERATION_RAD_S2 = np.array([9.5, 7.4, 9.5, 9.5, 9.5, 9.5, 9.5])
"""Of a stop, which is not replaced. Below the official 10 rad/s^2; joint 2 as the client library allows."""
MOTION_SHARE = 7.4 / 9.5
ACCELERATION_LIMIT_RAD_S2 = MOTION_SHARE * STOP_ACCELERATION_RAD_S2
"""Of motions, which may be replaced at any time; below that of a stop for the sake of jerk.

A motion that replaces another one is planned by the client library (franky 2.0.0,
`JointWaypointMotion::initWaypointMotion`) from the robot's `dq_d` and `ddq_d`. These are backward differences of the
commands: at an acceleration a the first is a * 0.5 ms too low, so that for one cycle the commands have half of the
acceleration. The robot sees a jerk of a / 2 ms + new jerk / 6: with 9.5 rad/s^2, and a new jerk of 2200 rad/s^3, 5117
of the official 5000, which franka-sim aborts; with these at most 4000.
"""
JERK_LIMIT_RAD_S3 = np.full(7, 1800.0)
"""Below half of the official 5000 rad/s^3, so that a stop which begins just after a missed cycle keeps to these at the
default dynamics factor. The client library counts what the arm does in such a cycle twice (`extrapolateMotion`)."""

_SLOWEST_RAD_S = 0.1
_LEAST_FACTOR = 0.01
"""Of the velocity, for motions that may take very long."""
_BRAKING_SHARE = 0.6
"""Share of the acceleration that the envelope counts on for braking."""
_AWAY = np.linspace(0.0, 1.5, 751)
_DECELERATION = np.minimum(np.array(BRAKING_DECELERATION_RAD_S2), _BRAKING_SHARE * ACCELERATION_LIMIT_RAD_S2)
_OFFSET = np.array(BRAKING_OFFSET_RAD_S)
MARGIN_RAD = (_OFFSET + 1.5 * _SLOWEST_RAD_S) ** 2 / (2.0 * _DECELERATION)
"""Nearest that a target may come to a joint's limit: nearer the envelope leaves no speed to arrive with."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Plan:
    """How to go to a target.

    Attributes:
        target: float64 (7,), within the limits less `MARGIN_RAD` [rad].
        velocity_factor: share of `VELOCITY_LIMIT_RAD_S` that is allowed.
        duration_s: estimate of the time until rest there.
    """

    target: F64
    velocity_factor: float
    duration_s: float


def plan(position: F64, target: F64, duration_s: float, factor: float) -> Plan:
    """How to go from `position` (7,) to `target` (7,) [rad] in about `duration_s`, with `factor` of the limits.

    The duration becomes a bound on the speed: given as a least time, the client library's planner (franky 2.0.0) failed
    on 18 of 43 targets that replaced a motion (ruckig's error -111), without one on 0 of 64.
    """
    clamped = np.clip(target, np.array(LOWER_RAD) + MARGIN_RAD, np.array(UPPER_RAD) - MARGIN_RAD)
    distance = clamped - position
    room = np.where(distance >= 0.0, np.array(UPPER_RAD) - clamped, clamped - np.array(LOWER_RAD))
    acceleration = factor * ACCELERATION_LIMIT_RAD_S2
    allowed = fastest_towards(room, acceleration)
    moving = np.abs(distance) > 1e-6
    share = np.minimum(1.0, allowed / VELOCITY_LIMIT_RAD_S)
    length = np.abs(distance)
    # the speed with which a trapezoid of velocity takes just duration_s; none when even a triangle takes longer
    room_s2 = (acceleration * duration_s) ** 2 - 4.0 * acceleration * length
    unhurried = np.where(room_s2 > 0.0, (acceleration * duration_s - np.sqrt(np.maximum(room_s2, 0.0))) / 2.0, np.inf)
    wanted = float((unhurried / VELOCITY_LIMIT_RAD_S).max())
    velocity_factor = float(min(factor, share[moving].min(initial=1.0), max(wanted, _LEAST_FACTOR)))
    speed = velocity_factor * VELOCITY_LIMIT_RAD_S
    times = np.where(
        length * acceleration > speed**2, length / speed + speed / acceleration, 2.0 * np.sqrt(length / acceleration)
    )
    ramps_s = acceleration / (factor * JERK_LIMIT_RAD_S3)
    return Plan(
        target=clamped,
        velocity_factor=velocity_factor,
        duration_s=max(duration_s, float((times + ramps_s).max())),
    )


def fastest_towards(room: F64, acceleration: F64) -> F64:
    """Cruising speed (7,) [rad/s] with which a joint, braking with `acceleration` to rest at `room` (7,) [rad] before
    its limit, is nowhere faster than the envelope."""
    away = _AWAY[:, None]
    envelope = np.sqrt(2.0 * _DECELERATION * (room + away)) - _OFFSET
    braking = np.sqrt(2.0 * acceleration * away)
    violated = braking > envelope
    violated[0] = envelope[0] <= 0.0
    first = np.where(violated.any(axis=0), violated.argmax(axis=0), len(_AWAY) - 1)
    speed: F64 = np.sqrt(2.0 * acceleration * _AWAY[np.maximum(first - 1, 0)])
    capped: F64 = np.clip(speed, _SLOWEST_RAD_S, np.array(VELOCITY_RAD_S))
    return capped


def braking_distance(velocity: F64, acceleration: F64) -> F64:
    """Way (7,) [rad] on which joints with `velocity` and `acceleration` (7,) [rad/s, rad/s^2] come to rest soonest.

    Jerk, acceleration and jerk again as the limits allow: where ruckig arrives without turning round.
    """
    limit, jerk = STOP_ACCELERATION_RAD_S2, JERK_LIMIT_RAD_S3
    # forward is where the joint would go if its acceleration ended at once; a start that brakes harder is over then
    forward = np.where(velocity + acceleration * np.abs(acceleration) / (2.0 * jerk) >= 0.0, 1.0, -1.0)
    v, a = forward * velocity, forward * acceleration
    peak = np.minimum(limit, np.sqrt(np.maximum(jerk * v + a * a / 2.0, 0.0)))
    ramp_s, end_s = np.maximum(a + peak, 0.0) / jerk, peak / jerk
    after_ramp = v + a * ramp_s - jerk * ramp_s**2 / 2.0
    level_s = np.maximum(after_ramp - peak * end_s / 2.0, 0.0) / np.maximum(peak, 1e-9)
    way = v * ramp_s + a * ramp_s**2 / 2.0 - jerk * ramp_s**3 / 6.0
    way += after_ramp * level_s - peak * level_s**2 / 2.0 + peak * end_s**2 / 6.0
    distance: F64 = forward * way
    return distance
