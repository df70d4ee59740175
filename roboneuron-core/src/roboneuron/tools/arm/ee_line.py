"""Straight move of the end effector: target, distance from it, and permitted step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from roboneuron.contract import Pose
from roboneuron.contract.arrays import F64
from roboneuron.contract.rotation import (
    matrix_from_quaternion,
    matrix_from_rotvec,
    rotvec_from_matrix,
)
from roboneuron.errors import RefusedError, StateError
from roboneuron.tools.arm.progress import MotionProgress

STEP_S = 0.1
"""Time between two actions."""
_RESERVE = 0.97
"""Fraction of a speed limit in use: an arm that starts from rest is slightly faster later in the
same step.
"""
_REACHED_M, _REACHED_RAD = 0.002, 0.01
_SETTLE_S = 2.0
"""Longest time without progress, after the nominal duration."""
_STILL_M, _STILL_RAD = 5e-4, 2.5e-3
"""Change of the TCP between two steps below which it has arrived, and is not passing through."""
_GRIPPER_S = 0.8
"""Least duration of a move with a gripper command, which is the time of opening or closing."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Order:
    """A requested move.

    Attributes:
        translation_m, rotation_rad: float64 (3,), in the base frame; the rotation as a rotation
            vector.
        gripper_open: 0 closed .. 1 open; None for no change.
        duration_s: time for the whole line.
        keeps_rotation: the hand ends as turned as asked. An arm with fewer than six joints cannot
            translate without turning: unless a turn is asked for, it turns as it must.
    """

    translation_m: F64
    rotation_rad: F64
    gripper_open: float | None
    duration_s: float
    keeps_rotation: bool = True

    def judged(self, displacement: F64) -> F64:
        """The part of a displacement (6,) that is to be made for the arm to have arrived."""
        if self.keeps_rotation:
            return displacement
        return np.concatenate([displacement[:3], np.zeros(3)])


def remaining(start: Pose, order: Order, fraction: float, measured: Pose) -> F64:
    """Displacement from `measured` to the point at `fraction` of the move: translation [m] and
    rotation vector [rad], (6,).
    """
    position = start.position_m + fraction * order.translation_m - measured.position_m
    rotation = matrix_from_rotvec(fraction * order.rotation_rad) @ matrix_from_quaternion(
        start.quaternion_xyzw
    )
    turn = rotvec_from_matrix(rotation @ matrix_from_quaternion(measured.quaternion_xyzw).T)
    return np.concatenate([position, turn])


def difference(start: Pose, end: Pose) -> F64:
    """Displacement between two poses in the base frame: translation [m] and rotation vector [rad],
    (6,).
    """
    turn = (
        matrix_from_quaternion(end.quaternion_xyzw)
        @ matrix_from_quaternion(start.quaternion_xyzw).T
    )
    return np.concatenate([end.position_m - start.position_m, rotvec_from_matrix(turn)])


def limit_step(delta: F64, speed_m_s: float, turn_rad_s: float, *, is_straight: bool = True) -> F64:
    """Shorten `delta` (6,), relative to the measured arm, to the speed limits of one step.

    A delayed arm continues at its speed, without catching up.

    Args:
        delta: translation [m] and rotation vector [rad].
        speed_m_s, turn_rad_s: limits.
        is_straight: both are shortened alike; otherwise a rotation that the arm cannot make delays
            no translation.
    """
    scales = np.ones(2)
    for number, limit in enumerate((speed_m_s, turn_rad_s)):
        length = float(np.linalg.norm(delta[3 * number : 3 * number + 3]))
        if length > 0.0:
            scales[number] = min(1.0, _RESERVE * limit * STEP_S / length)
    if is_straight:
        scales[:] = scales.min()
    limited: F64 = delta * np.repeat(scales, 3)
    return limited


def _paced(order: Order, speeds: tuple[float, float]) -> tuple[float, float]:
    """The speeds of a move [m/s, rad/s]: those of its duration, so that one that was kept back does
    not catch up; at most `speeds`. A part that is not asked for is corrected at these.
    """
    way_m = float(np.linalg.norm(order.translation_m))
    way_rad = float(np.linalg.norm(order.rotation_rad))
    speed_m_s, turn_rad_s = speeds
    if way_m > _REACHED_M:
        speed_m_s = min(speed_m_s, way_m / order.duration_s / _RESERVE)
    if way_rad > _REACHED_RAD:
        turn_rad_s = min(turn_rad_s, way_rad / order.duration_s / _RESERVE)
    return speed_m_s, turn_rad_s


def steps_to_end(
    order: Order,
    start: Pose,
    pose: Callable[[], Pose],
    elapsed_s: Callable[[], float],
    note: Callable[[], str],
    *,
    speeds: tuple[float, float],
    longest_s: float,
) -> Iterator[tuple[float, float, Pose, F64]]:
    """Yield steps towards the end of the line from the present pose: fraction of the line,
    remaining distance [m], that pose, delta from it (6,); ends when the arm has arrived.

    Args:
        order: the move.
        start: start of the line.
        pose: returns the present pose.
        elapsed_s: returns the time since the first step.
        note: returns control's status note.
        speeds: fastest translation [m/s] and rotation [rad/s].
        longest_s: longest duration [s].

    Raises:
        RefusedError: control held the arm, with its reason.
        StateError: the arm did not arrive.
    """
    speed_m_s, turn_rad_s = _paced(order, speeds)
    least_s = max(order.duration_s, _GRIPPER_S if order.gripper_open is not None else 0.0)
    progress, before = MotionProgress(least_s, longest_s, _SETTLE_S), start
    while True:
        now_s, here = elapsed_s(), pose()
        error = order.judged(remaining(start, order, 1.0, here))
        left_m, left_rad = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
        way, before = difference(before, here), here
        is_still = (
            float(np.linalg.norm(way[:3])) < _STILL_M
            and float(np.linalg.norm(way[3:])) < _STILL_RAD
        )
        if left_m < _REACHED_M and left_rad < _REACHED_RAD and now_s >= least_s and is_still:
            return
        if progress.is_stuck(left_m + left_rad, now_s):
            text = f"The end effector is {left_m * 1000:.1f} mm and {left_rad:.3f} rad short"
            told = note()
            if told.startswith("holding"):
                raise RefusedError(f"{text}; control is {told}", rule="path")
            raise StateError(f"{text} ({told or 'no report of control'}).")
        fraction = min(1.0, (now_s + STEP_S) / order.duration_s)
        delta = limit_step(
            remaining(start, order, fraction, here),
            speed_m_s,
            turn_rad_s,
            is_straight=order.keeps_rotation,
        )
        yield fraction, left_m, here, delta


def rounded(values: F64) -> list[float]:
    """Round values for results: five decimals, no negative zero, 0 for non-finite values."""
    return [round(float(value), 5) + 0.0 if math.isfinite(value) else 0.0 for value in values]
