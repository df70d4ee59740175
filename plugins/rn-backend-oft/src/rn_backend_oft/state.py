"""Conversion of the contract's measured state to the checkpoint's proprioception."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from rn_backend_oft.constants import StateLayout
from rn_vla.rotation import rotvec_by_down, rotvec_by_quaternion, rpy_by_down
from roboneuron import ConfigurationError, Observation, UngroundedError, matrix_from_quaternion

F64 = NDArray[np.float64]

STATE_WIDTHS: Mapping[StateLayout, int] = MappingProxyType(
    {"xyz_rotvec_fingers": 8, "xyz_rpy_opening": 7}
)
"""Number of values of each layout that is read from one arm's TCP pose and gripper."""


def state_width(layout: StateLayout) -> int:
    """Number of values of the layout. Raises ConfigurationError for one that TCP pose and gripper
    do not define.
    """
    if layout not in STATE_WIDTHS:
        raise ConfigurationError(
            f"The state layout {layout!r} is no TCP pose and gripper.",
            hint=f"Layouts that can be filled: {', '.join(STATE_WIDTHS)}.",
        )
    return STATE_WIDTHS[layout]


def read_state(
    observation: Observation,
    layout: StateLayout,
    *,
    finger_travel_m: float,
    origin_m: F64,
    finger_joints: tuple[str, str] | None = None,
    by_quaternion: bool = False,
) -> F64:
    """Measured state (n,): TCP position [m], then, depending on the layout,

    - "xyz_rotvec_fingers": rotation vector [rad] near that of a gripper pointing down (or, with
      `by_quaternion`, of up to 2 pi, following the quaternion's sign), both finger joints [m] (the
      second one negative; measured if `finger_joints` names them); as in LIBERO;
    - "xyz_rpy_opening": roll, pitch, yaw [rad] relative to a gripper pointing down, opening 0
      closed .. 1 open; as in BridgeData.

    Raises:
        UngroundedError: pose or gripper is missing or not finite; no value is substituted.
    """
    pose, opening = observation.ee_pose, observation.gripper_open
    if pose is None or opening is None:
        missing = "TCP pose" if pose is None else "gripper opening"
        raise UngroundedError(
            f"The observation has no {missing}, which the checkpoint's proprioception needs."
        )
    rotation = matrix_from_quaternion(pose.quaternion_xyzw)
    position = pose.position_m + origin_m
    if layout == "xyz_rotvec_fingers":
        fingers = [opening * finger_travel_m, -opening * finger_travel_m]
        if finger_joints is not None:
            fingers = _measured(observation, finger_joints)
        turn = (
            rotvec_by_quaternion(pose.quaternion_xyzw)
            if by_quaternion
            else rotvec_by_down(rotation)
        )
        state = np.concatenate([position, turn, fingers])
    else:
        state = np.concatenate([position, rpy_by_down(rotation), [opening]])
    if not np.isfinite(state).all():
        raise UngroundedError(
            f"The measured state holds a non-finite value: {np.round(state, 4).tolist()}."
        )
    return state


def _measured(observation: Observation, names: tuple[str, str]) -> list[float]:
    joints = observation.joints
    absent = [name for name in names if joints is None or name not in joints.names]
    if joints is None or absent:
        raise UngroundedError(
            f"The observation has no joint {absent}, whose position the checkpoint's state needs."
        )
    return [float(joints.position[joints.names.index(name)]) for name in names]
