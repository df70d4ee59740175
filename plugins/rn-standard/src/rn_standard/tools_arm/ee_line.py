"""A straight move of the end effector: where it should be, how far it is from there, what one step
may ask for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron import (
    Pose,
    RefusedError,
    StateError,
    matrix_from_quaternion,
    matrix_from_rotvec,
    rotvec_from_matrix,
)

F64 = NDArray[np.float64]
STEP_S = 0.1
"""Time between two actions."""
_RESERVE = 0.97
"""Share of a speed limit in use: an arm that starts from rest is a little faster later in the same
step.
"""
_REACHED_M, _REACHED_RAD = 0.002, 0.01
_SETTLE_S = 2.0
"""How long the arm may come no nearer, after the nominal duration."""
_NEARER = 5e-4
"""Less than this [m and rad together] is no progress."""
_STILL_M, _STILL_RAD = 5e-4, 2.5e-3
"""A TCP that moves less than this between two steps has arrived, and does not pass through."""
_GRIPPER_S = 0.8
"""Least time of a move with a command to the gripper: so long it opens or closes."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Order:
    """A move as it was asked for.

    Attributes:
        translation_m, rotation_rad: float64 (3,), in the base frame; the rotation as a rotation
            vector.
        gripper_open: 0 closed .. 1 open; None: as it is.
        duration_s: time for the whole line.
    """

    translation_m: F64
    rotation_rad: F64
    gripper_open: float | None
    duration_s: float


def remaining(start: Pose, order: Order, fraction: float, measured: Pose) -> F64:
    """From `measured` to the point at `fraction` of the move: translation [m] and rotation vector
    [rad], (6,).
    """
    position = start.position_m + fraction * order.translation_m - measured.position_m
    rotation = matrix_from_rotvec(fraction * order.rotation_rad) @ matrix_from_quaternion(
        start.quaternion_xyzw
    )
    turn = rotvec_from_matrix(rotation @ matrix_from_quaternion(measured.quaternion_xyzw).T)
    return np.concatenate([position, turn])


def difference(start: Pose, end: Pose) -> F64:
    """The move from one pose to another in the base frame: translation [m] and rotation vector
    [rad], (6,).
    """
    turn = (
        matrix_from_quaternion(end.quaternion_xyzw)
        @ matrix_from_quaternion(start.quaternion_xyzw).T
    )
    return np.concatenate([end.position_m - start.position_m, rotvec_from_matrix(turn)])


def limit_step(delta: F64, speed_m_s: float, turn_rad_s: float) -> F64:
    """`delta` (6,), from where the arm is measured, shortened to what the speed limits allow in one
    step.

    An arm that was held up goes on at its speed: it catches up nothing.
    """
    scales = [1.0]
    for part, limit in ((delta[:3], speed_m_s), (delta[3:], turn_rad_s)):
        length = float(np.linalg.norm(part))
        if length > 0.0:
            scales.append(_RESERVE * limit * STEP_S / length)
    limited: F64 = delta * min(scales)
    return limited


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
    """Steps towards the end of the line by the present pose: share of the line, distance left
    [m], that pose, delta from it (6,); ends when the arm is there.

    Args:
        order: the move.
        start: where the line begins.
        pose: the present pose.
        elapsed_s: time since the first step.
        note: what control is doing, in its own words.
        speeds: fastest move [m/s] and turn [rad/s].
        longest_s: it ends after so much time, wherever the arm is.

    Raises:
        RefusedError: control held the arm, with its reason.
        StateError: the arm did not get there.
    """
    speed_m_s, turn_rad_s = speeds
    least_s = max(order.duration_s, _GRIPPER_S if order.gripper_open is not None else 0.0)
    nearest, nearest_s, before = np.inf, least_s, start
    while True:
        now_s, here = elapsed_s(), pose()
        error = remaining(start, order, 1.0, here)
        left_m, left_rad = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
        way, before = difference(before, here), here
        is_still = (
            float(np.linalg.norm(way[:3])) < _STILL_M
            and float(np.linalg.norm(way[3:])) < _STILL_RAD
        )
        if left_m < _REACHED_M and left_rad < _REACHED_RAD and now_s >= least_s and is_still:
            return
        if left_m + left_rad < nearest - _NEARER:
            nearest, nearest_s = left_m + left_rad, max(now_s, least_s)
        if now_s > min(nearest_s + _SETTLE_S, longest_s):
            text = f"The end effector is {left_m * 1000:.1f} mm and {left_rad:.3f} rad short"
            told = note()
            if told.startswith("holding"):
                raise RefusedError(f"{text}; control is {told}", rule="path")
            raise StateError(f"{text} ({told or 'no report of control'}).")
        fraction = min(1.0, (now_s + STEP_S) / order.duration_s)
        delta = limit_step(remaining(start, order, fraction, here), speed_m_s, turn_rad_s)
        yield fraction, left_m, here, delta


def rounded(values: F64) -> list[float]:
    """For results: five decimals, no negative zero, 0 for what is not finite."""
    return [round(float(value), 5) + 0.0 if math.isfinite(value) else 0.0 for value in values]
