"""Rotations in the contract: rotation vectors [rad], 3x3 matrices, unit quaternions in x y z w
order.
"""

from __future__ import annotations

import math

import numpy as np

from roboneuron.contract.arrays import F64

_SMALL_ANGLE_RAD = 1e-8
"""Angle below which the error of the linear terms (its square) is below float64 rounding."""


def matrix_from_rotvec(rotvec_rad: F64) -> F64:
    """Exponential map: rotation vector (3,) [rad] -> rotation matrix (3, 3).

    R = I + sin(a) / a K + (1 - cos(a)) / a^2 K^2, with the angle a and K v = rotvec x v.

    Source: Rodrigues' formula.
    """
    angle = float(np.linalg.norm(rotvec_rad))
    x, y, z = rotvec_rad.tolist()
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # sin(a) / a, and (1 - cos(a)) / a^2 by the half angle: 1 - cos(a) would lose small angles
    linear, square = 1.0, 0.5
    if angle > 0.0:
        linear, square = math.sin(angle) / angle, 2.0 * (math.sin(angle / 2.0) / angle) ** 2
    matrix: F64 = np.eye(3) + linear * skew + square * (skew @ skew)
    return matrix


def rotvec_from_matrix(matrix: F64) -> F64:
    """Logarithmic map: rotation matrix (3, 3) -> rotation vector (3,) [rad], angle in [0, pi].

    Computed from the quaternion (sin(a/2) axis, cos(a/2)), which, unlike the trace of the matrix,
    is accurate for small angles and those close to pi.
    """
    *axis, w = quaternion_from_matrix(matrix).tolist()
    sine = math.hypot(*axis)
    angle = 2.0 * math.atan2(sine, w)
    rotvec: F64 = np.array(axis) * (angle / sine if sine >= _SMALL_ANGLE_RAD else 2.0)
    return rotvec


def quaternion_from_matrix(matrix: F64) -> F64:
    """Rotation matrix (3, 3) -> unit quaternion (4,) x y z w with w >= 0.

    The row of the largest of 4x^2, 4y^2, 4z^2 and 4w^2 is normalised: never one close to 0.

    Source: Shepperd 1978 (largest pivot).
    """
    a, b, c, d, e, f, g, h, i = matrix.ravel().tolist()
    # 4 q q^T: each of its rows is a multiple of the quaternion
    products = np.array(
        [
            [1.0 + a - e - i, d + b, g + c, h - f],
            [d + b, 1.0 - a + e - i, h + f, c - g],
            [g + c, h + f, 1.0 - a - e + i, d - b],
            [h - f, c - g, d - b, 1.0 + a + e + i],
        ]
    )
    q: F64 = products[int(products.diagonal().argmax())]
    q /= np.linalg.norm(q)
    return q if q[3] >= 0 else -q


def matrix_from_quaternion(quaternion_xyzw: F64) -> F64:
    """Quaternion (4,) x y z w (normalised here) -> rotation matrix (3, 3)."""
    x, y, z, w = quaternion_xyzw / np.linalg.norm(quaternion_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
