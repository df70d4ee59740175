"""Roll, pitch and yaw about fixed x, y, z axes: R = Rz(yaw) Ry(pitch) Rx(roll)."""

from __future__ import annotations

import math

import numpy as np

from roboneuron.contract.rotation import F64, matrix_from_rotvec


def matrix_from_rpy(rpy_rad: F64) -> F64:
    """Roll, pitch, yaw (3,) [rad] -> rotation matrix (3, 3)."""
    x, y, z = (matrix_from_rotvec(np.eye(3)[i] * rpy_rad[i]) for i in range(3))
    out: F64 = z @ y @ x
    return out


def rpy_from_matrix(matrix: F64) -> F64:
    """Rotation matrix (3, 3) -> roll, pitch, yaw (3,) [rad]; pitch in [-pi/2, pi/2], roll 0 where it is ambiguous."""
    cosine = math.hypot(matrix[0, 0], matrix[1, 0])
    pitch = math.atan2(-matrix[2, 0], cosine)
    if cosine < 1e-9:
        return np.array([0.0, pitch, math.atan2(-matrix[0, 1], matrix[1, 1])])
    return np.array([math.atan2(matrix[2, 1], matrix[2, 2]), pitch, math.atan2(matrix[1, 0], matrix[0, 0])])
