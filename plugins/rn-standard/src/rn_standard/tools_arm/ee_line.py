"""A straight move of the end effector: where it should be, how far it is from there, what one step
may ask for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron import Pose, matrix_from_quaternion, matrix_from_rotvec, rotvec_from_matrix

F64 = NDArray[np.float64]
STEP_S = 0.1
"""Time between two actions."""
_RESERVE = 0.97
"""Share of a speed limit in use: an arm that starts from rest is a little faster later in the same
step.
"""


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


def rounded(values: F64) -> list[float]:
    """For results: five decimals, no negative zero, 0 for what is not finite."""
    return [round(float(value), 5) + 0.0 if math.isfinite(value) else 0.0 for value in values]
