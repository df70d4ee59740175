"""Meaning of a checkpoint's action values, and their conversion to the contract's 7-vector and
back.

The table of all profiles is in docs/vla.md; this module is its only implementation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_vla.rotation import matrix_from_rpy, rpy_from_matrix
from roboneuron import (
    InvalidInputError,
    Pose,
    matrix_from_quaternion,
    matrix_from_rotvec,
    rotvec_from_matrix,
)

F64 = NDArray[np.float64]
RotationUnit = Literal["rotvec", "rpy"]
GripperSign = Literal["open_fraction", "closed_fraction", "signed_open", "signed_close"]

# (slope, offset) of: opening = slope * value + offset
_GRIPPER: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "open_fraction": (1.0, 0.0),
        "closed_fraction": (-1.0, 1.0),
        "signed_open": (0.5, 0.5),
        "signed_close": (-0.5, 0.5),
    }
)


@dataclass(frozen=True, kw_only=True, slots=True)
class ActionProfile:
    """Meaning of seven un-normalised model values: translation, rotation, gripper.

    Attributes:
        metres_per_unit, radians_per_unit: scale of the first and the second three values.
        rotation: "rotvec", or "rpy" about fixed axes (R = Rz(yaw) Ry(pitch) Rx(roll)).
        frame: "base", or "tcp" for deltas along the tool's own axes.
        gripper: "open_fraction" 0 closed .. 1 open, "closed_fraction" the reverse, "signed_open" -1
            closed .. 1 open, "signed_close" -1 open .. 1 closed.
        gripper_threshold: round the opening to 0 or 1.
        clip_units: clip the first six values to [-1, 1] before scaling.
        step_s: time between two actions [s].
    """

    metres_per_unit: float
    radians_per_unit: float
    rotation: RotationUnit
    frame: Literal["base", "tcp"]
    gripper: GripperSign
    gripper_threshold: bool
    clip_units: bool
    step_s: float

    def to_contract(self, native: F64, tcp: Pose | None = None) -> F64:
        """Convert model values (H, 7) to contract actions (H, 7): metres, rotation vector [rad] in
        base axes, opening 0..1.

        Args:
            native: un-normalised model values.
            tcp: TCP pose in the base frame at the first action; needed for frame "tcp". The frames
                of later actions in a chunk follow from the actions before them.

        Raises:
            InvalidInputError: frame "tcp" without a pose.
        """
        contract = np.empty_like(native)
        motion = np.clip(native[:, :6], -1.0, 1.0) if self.clip_units else native[:, :6]
        contract[:, :3] = motion[:, :3] * self.metres_per_unit
        turns = motion[:, 3:] * self.radians_per_unit
        contract[:, 3:6] = (
            [rotvec_from_matrix(matrix_from_rpy(t)) for t in turns]
            if self.rotation == "rpy"
            else turns
        )
        slope, offset = _GRIPPER[self.gripper]
        opening = np.clip(slope * native[:, 6] + offset, 0.0, 1.0)
        contract[:, 6] = (opening > 0.5).astype(np.float64) if self.gripper_threshold else opening
        if self.frame == "tcp":
            axes = _tool_axes(tcp)
            for row in contract:
                row[:3], row[3:6] = axes @ row[:3], axes @ row[3:6]
                axes = matrix_from_rotvec(row[3:6]) @ axes
        return contract

    def to_native(self, contract: F64, tcp: Pose | None = None) -> F64:
        """Convert contract actions (H, 7) to model values (H, 7); the inverse of `to_contract` if
        nothing was clipped.

        Raises:
            InvalidInputError: frame "tcp" without a pose.
        """
        native = contract.copy()
        if self.frame == "tcp":
            axes = _tool_axes(tcp)
            for row, given in zip(native, contract, strict=True):
                row[:3], row[3:6] = axes.T @ given[:3], axes.T @ given[3:6]
                axes = matrix_from_rotvec(given[3:6]) @ axes
        native[:, :3] /= self.metres_per_unit
        if self.rotation == "rpy":
            native[:, 3:6] = [rpy_from_matrix(matrix_from_rotvec(r)) for r in native[:, 3:6]]
        native[:, 3:6] /= self.radians_per_unit
        slope, offset = _GRIPPER[self.gripper]
        native[:, 6] = (native[:, 6] - offset) / slope
        return native


def _tool_axes(tcp: Pose | None) -> F64:
    if tcp is None:
        raise InvalidInputError(
            'Actions in the frame "tcp" need the measured TCP pose, but the observation has none.'
        )
    return matrix_from_quaternion(tcp.quaternion_xyzw)


PROFILES: Mapping[str, ActionProfile] = MappingProxyType(
    {
        # Source: robosuite OSC_POSE as LIBERO configures it (output_max 0.05 m, 0.5 rad; input
        # clipped to [-1, 1]; 20 Hz); OpenVLA's LIBERO data say 1 for an open gripper.
        "libero": ActionProfile(
            metres_per_unit=0.05,
            radians_per_unit=0.5,
            rotation="rotvec",
            frame="base",
            gripper="open_fraction",
            gripper_threshold=True,
            clip_units=True,
            step_s=0.05,
        ),
        # Source: BridgeData V2 in Open X-Embodiment: metres, roll-pitch-yaw, 5 Hz, gripper 1 open.
        "bridge": ActionProfile(
            metres_per_unit=1.0,
            radians_per_unit=1.0,
            rotation="rpy",
            frame="base",
            gripper="open_fraction",
            gripper_threshold=True,
            clip_units=False,
            step_s=0.2,
        ),
    }
)
"""Profiles by name."""
