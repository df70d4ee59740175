"""Conversion of targets to a `JointTrajectory`: durations within the limits, and braking to a
standstill. Pure computation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from builtin_interfaces.msg import Duration
from numpy.typing import NDArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboneuron import JointLimits

F64 = NDArray[np.float64]
_CUBIC_PEAK = 1.5
"""Peak velocity of a cubic from rest to rest, as a multiple of the mean."""
_CUBIC_ACCELERATION = 6.0
"""Peak acceleration of a cubic is 6 distance / duration^2, at both ends."""
_LEAST_S = 0.02
_BRAKING_SHARE = 0.8
"""Fraction of the acceleration limit used by a stop: the measured velocity is not exact."""


def to_duration(seconds: float) -> Duration:
    """Seconds -> builtin_interfaces/Duration."""
    total = round(seconds * 1e9)
    return Duration(sec=int(total // 1_000_000_000), nanosec=int(total % 1_000_000_000))


def shortest_s(start: F64, goal: F64, limits: JointLimits, *, cubic: bool) -> float:
    """Shortest duration of one segment from `start` to `goal`, float64 (n,), within velocity (and
    acceleration) limits.
    """
    distance = np.abs(goal - start)
    if not cubic:
        return float(np.max(distance / limits.velocity, initial=_LEAST_S))
    by_velocity = _CUBIC_PEAK * distance / limits.velocity
    by_acceleration = np.sqrt(_CUBIC_ACCELERATION * distance / limits.acceleration)
    return float(np.max(np.maximum(by_velocity, by_acceleration), initial=_LEAST_S))


def rows_within(
    left_s: float,
    goal: F64,
    names: Sequence[str],
    positions: Sequence[Mapping[str, float]],
    durations_s: Sequence[float],
    limits: JointLimits,
) -> list[tuple[F64, float]]:
    """Further targets after `goal`, with the time for each [s], until `left_s` is used up.

    Args:
        left_s: total time [s].
        goal: starting position, float64 (n,), in the order of `names`.
        positions: targets by joint; a joint that is not named stays.
        durations_s: requested durations; the limits may require longer ones.
    """
    rows: list[tuple[F64, float]] = []
    for wanted, asked_s in zip(positions, durations_s, strict=True):
        asked = [wanted.get(name, float(place)) for name, place in zip(names, goal, strict=True)]
        then = np.clip(np.array(asked), limits.lower, limits.upper)
        duration_s = max(asked_s, shortest_s(goal, then, limits, cubic=False))
        left_s -= duration_s
        if left_s < 0.0:
            break
        rows.append((then, duration_s))
        goal = then
    return rows


def stop_point(position: F64, velocity: F64, limits: JointLimits) -> tuple[F64, float]:
    """Position and time at which an arm comes to rest from `position` with `velocity`, each (n,).

    All joints brake evenly for the time T that the slowest needs. The cubic from there with
    velocity zero at the end is then exactly the parabola p + v t - v t^2 / (2 T): constant
    deceleration, no overshoot.
    """
    duration_s = float(
        np.max(np.abs(velocity) / (_BRAKING_SHARE * limits.acceleration), initial=_LEAST_S)
    )
    return np.clip(position + velocity * duration_s / 2.0, limits.lower, limits.upper), duration_s


def to_message(
    names: Sequence[str], rows: Sequence[tuple[F64, float]], *, rest: bool
) -> JointTrajectory:
    """Create a trajectory that begins on arrival: each position (n,) with the time from the
    previous one [s]; with `rest`, with zero velocity at each.
    """
    points: list[JointTrajectoryPoint] = []
    elapsed_s = 0.0
    for position, duration_s in rows:
        elapsed_s += duration_s
        point = JointTrajectoryPoint(positions=[float(value) for value in position])
        if rest:
            point.velocities = [0.0] * len(names)
        point.time_from_start = to_duration(elapsed_s)
        points.append(point)
    return JointTrajectory(joint_names=list(names), points=points)
