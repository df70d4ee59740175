"""Rotations as the contract uses them: rotation vectors [rad], 3x3 matrices, unit quaternions in x y z w order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
_SMALL_ANGLE_RAD = 1e-8
DOWN_ROTVEC_RAD = (np.pi, 0.0, 0.0)
"""Rotation vector [rad] of a gripper that points down, x forward; the z axis of the TCP points out of the gripper."""


def matrix_from_rotvec(rotvec_rad: F64) -> F64:
    """Exponential map: rotation vector (3,) [rad] -> rotation matrix (3, 3). Source: Rodrigues' formula."""
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
    """Logarithmic map: rotation matrix (3, 3) -> rotation vector (3,) [rad], angle in [0, pi]."""
    x, y, z, w = quaternion_from_matrix(matrix)
    sine = float(np.sqrt(x * x + y * y + z * z))
    angle = 2.0 * float(np.arctan2(sine, w))
    if sine < _SMALL_ANGLE_RAD:
        return np.array([2.0 * x, 2.0 * y, 2.0 * z])
    return np.array([x, y, z]) * (angle / sine)


def quaternion_from_matrix(matrix: F64) -> F64:
    """Rotation matrix (3, 3) -> unit quaternion (4,) x y z w with w >= 0. Source: Shepperd 1978 (largest pivot)."""
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


def nearer_rotvec(rotvec_rad: F64, near_rad: F64) -> F64:
    """Of the two rotation vectors of one rotation, each up to 2 pi long, the one nearer to `near_rad`; (3,) [rad]."""
    angle = float(np.linalg.norm(rotvec_rad))
    if angle < _SMALL_ANGLE_RAD:
        return rotvec_rad
    other: F64 = rotvec_rad * ((angle - 2.0 * np.pi) / angle)
    nearer = np.linalg.norm(rotvec_rad - near_rad) <= np.linalg.norm(other - near_rad)
    return rotvec_rad if nearer else other


def matrix_from_rpy(rpy_rad: F64) -> F64:
    """Roll, pitch, yaw (3,) [rad] about fixed x, y, z -> rotation matrix (3, 3), Rz(yaw) Ry(pitch) Rx(roll)."""
    x, y, z = (matrix_from_rotvec(axis * angle) for axis, angle in zip(np.eye(3), rpy_rad, strict=True))
    out: F64 = z @ y @ x
    return out


def rpy_from_matrix(matrix: F64) -> F64:
    """Rotation matrix (3, 3) -> roll, pitch, yaw (3,) [rad]; pitch in [-pi/2, pi/2], roll 0 where it is ambiguous."""
    cosine = np.hypot(matrix[0, 0], matrix[1, 0])
    pitch = np.arctan2(-matrix[2, 0], cosine)
    if cosine < _SMALL_ANGLE_RAD:
        return np.array([0.0, pitch, np.arctan2(-matrix[0, 1], matrix[1, 1])])
    return np.array([np.arctan2(matrix[2, 1], matrix[2, 2]), pitch, np.arctan2(matrix[1, 0], matrix[0, 0])])


def rotvec_by_down(matrix: F64) -> F64:
    """TCP rotation (3, 3) -> rotation vector (3,) [rad] in the branch of a gripper that points down, up to 2 pi long.

    It is continuous through pi, where `rotvec_from_matrix` changes sign. Source: LIBERO's robot state is robosuite's
    quat2axisangle of MuJoCo's body quaternion, whose sign is not normalised (openvla-oft experiments/robot/libero,
    openpi examples/libero); its x component lies around pi in the data sets.
    """
    return nearer_rotvec(rotvec_from_matrix(matrix), np.array(DOWN_ROTVEC_RAD))


def rpy_by_down(matrix: F64) -> F64:
    """TCP rotation (3, 3) -> roll, pitch, yaw (3,) [rad] against a gripper that points down, for which they are 0.

    Source: BridgeData states are taken against a top-down pose: bridge_data_robot, widowx_controller, DEFAULT_ROTATION
    [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]; SimplerEnv and open-pi-zero undo it likewise (R @ DEFAULT_ROTATION.T). That R is
    of the WidowX link, whose x axis points out of the gripper. With the TCP's z axis out of the gripper, the same pose
    is R @ diag(1, -1, -1).
    """
    return rpy_from_matrix(matrix @ matrix_from_rotvec(np.array(DOWN_ROTVEC_RAD)).T)
