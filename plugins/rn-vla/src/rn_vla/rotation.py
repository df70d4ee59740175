"""Rotations in training data of VLA models: roll-pitch-yaw, and branches near a gripper that points
down.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from roboneuron import matrix_from_rotvec, rotvec_from_matrix

F64 = NDArray[np.float64]
_SMALL_ANGLE_RAD = 1e-8
DOWN_ROTVEC_RAD = (np.pi, 0.0, 0.0)
"""Rotation vector [rad] of a gripper that points down, x forward; the z axis of the TCP points out
of the gripper.
"""


def nearer_rotvec(rotvec_rad: F64, near_rad: F64) -> F64:
    """The nearer one to `near_rad` of a rotation's two rotation vectors, each up to 2 pi long; (3,)
    [rad].
    """
    angle = float(np.linalg.norm(rotvec_rad))
    if angle < _SMALL_ANGLE_RAD:
        return rotvec_rad
    other: F64 = rotvec_rad * ((angle - 2.0 * np.pi) / angle)
    nearer = np.linalg.norm(rotvec_rad - near_rad) <= np.linalg.norm(other - near_rad)
    return rotvec_rad if nearer else other


def matrix_from_rpy(rpy_rad: F64) -> F64:
    """Rotation matrix (3, 3), Rz(yaw) Ry(pitch) Rx(roll), of roll, pitch, yaw (3,) [rad] about
    fixed x, y, z.
    """
    x, y, z = (
        matrix_from_rotvec(axis * angle) for axis, angle in zip(np.eye(3), rpy_rad, strict=True)
    )
    out: F64 = z @ y @ x
    return out


def rpy_from_matrix(matrix: F64) -> F64:
    """Roll, pitch, yaw (3,) [rad] of a rotation matrix (3, 3); pitch in [-pi/2, pi/2], roll 0 if
    ambiguous.
    """
    cosine = np.hypot(matrix[0, 0], matrix[1, 0])
    pitch = np.arctan2(-matrix[2, 0], cosine)
    if cosine < _SMALL_ANGLE_RAD:
        return np.array([0.0, pitch, np.arctan2(-matrix[0, 1], matrix[1, 1])])
    return np.array(
        [np.arctan2(matrix[2, 1], matrix[2, 2]), pitch, np.arctan2(matrix[1, 0], matrix[0, 0])]
    )


def rotvec_by_down(matrix: F64) -> F64:
    """Rotation vector (3,) [rad] of a TCP rotation (3, 3), in the branch of a gripper that points
    down, up to 2 pi long.

    It is continuous at pi, where `rotvec_from_matrix` changes sign. Source: LIBERO's robot state is
    robosuite's quat2axisangle of MuJoCo's body quaternion, whose sign is not normalised
    (openvla-oft experiments/robot/libero, openpi examples/libero); its x component lies around pi
    in the data sets.
    """
    return nearer_rotvec(rotvec_from_matrix(matrix), np.array(DOWN_ROTVEC_RAD))


def rotvec_by_quaternion(quaternion_xyzw: F64) -> F64:
    """Rotation vector (3,) [rad] of a unit quaternion (4,), 0 .. 2 pi long: q and -q give different
    ones.

    Source: robosuite's quat2axisangle, copied by the LIBERO evaluations of OpenVLA-OFT and openpi.
    """
    w = float(np.clip(quaternion_xyzw[3], -1.0, 1.0))
    sine = np.sqrt(1.0 - w * w)
    if sine == 0.0:
        return np.zeros(3)
    vector: F64 = quaternion_xyzw[:3] * 2.0 * np.arccos(w) / sine
    return vector


def rpy_by_down(matrix: F64) -> F64:
    """Roll, pitch, yaw (3,) [rad] of a TCP rotation (3, 3), relative to a gripper that points down,
    for which they are 0.

    Source: BridgeData states are relative to a top-down pose: bridge_data_robot, widowx_controller,
    DEFAULT_ROTATION [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]; SimplerEnv and open-pi-zero undo it
    likewise (R @ DEFAULT_ROTATION.T). That R is of the WidowX link, whose x axis points out of the
    gripper. With the TCP's z axis out of the gripper, the same pose is R @ diag(1, -1, -1).
    """
    return rpy_from_matrix(matrix @ matrix_from_rotvec(np.array(DOWN_ROTVEC_RAD)).T)
