"""Rotations as the contract uses them: rotation vectors [rad], 3x3 matrices, unit quaternions in x
y z w order.
"""

from __future__ import annotations

import numpy as np

from roboneuron.contract.arrays import F64

_SMALL_ANGLE_RAD = 1e-8
"""Below it, what the linear terms leave out (its square) is less than what a float64 rounds."""


def matrix_from_rotvec(rotvec_rad: F64) -> F64:
    """Exponential map: rotation vector (3,) [rad] -> rotation matrix (3, 3).

    R = I + sin(a) K + (1 - cos(a)) K^2, with the angle a and K v = axis x v.

    Source: Rodrigues' formula.
    """
    angle = float(np.linalg.norm(rotvec_rad))
    x, y, z = (float(c) for c in rotvec_rad)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: F64 = np.eye(3)
    if angle >= _SMALL_ANGLE_RAD:
        skew /= angle
        matrix = matrix + np.sin(angle) * skew + (1.0 - np.cos(angle)) * (skew @ skew)
    else:
        matrix = matrix + skew
    return matrix


def rotvec_from_matrix(matrix: F64) -> F64:
    """Logarithmic map: rotation matrix (3, 3) -> rotation vector (3,) [rad], angle in [0, pi].

    By the quaternion (sin(a/2) axis, cos(a/2)): unlike the trace of the matrix, it tells small
    angles and those close to pi as well as all others.
    """
    x, y, z, w = quaternion_from_matrix(matrix)
    sine = float(np.sqrt(x * x + y * y + z * z))
    angle = 2.0 * float(np.arctan2(sine, w))
    if sine < _SMALL_ANGLE_RAD:
        return np.array([2.0 * x, 2.0 * y, 2.0 * z])
    return np.array([x, y, z]) * (angle / sine)


def quaternion_from_matrix(matrix: F64) -> F64:
    """Rotation matrix (3, 3) -> unit quaternion (4,) x y z w with w >= 0.

    The largest of 4x^2, 4y^2, 4z^2 and 4w^2, each but for a constant, is divided by: never a number
    close to 0.

    Source: Shepperd 1978 (largest pivot).
    """
    m = matrix
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    pivots = np.array([m[0, 0], m[1, 1], m[2, 2], trace])
    i = int(np.argmax(pivots))
    q = np.empty(4)
    if i == 3:
        q[:] = (m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1.0 + trace)
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + m[i, i] - m[j, j] - m[k, k]
        q[j] = m[j, i] + m[i, j]
        q[k] = m[k, i] + m[i, k]
        q[3] = m[k, j] - m[j, k]
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
