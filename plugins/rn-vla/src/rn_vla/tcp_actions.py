"""Meaning of a checkpoint's action values, and the conversion to and from the contract's
7-vector.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rn_vla.rotation import F64, matrix_from_rpy, rpy_from_matrix
from roboneuron import (
    ACTION_SIZE,
    ConfigurationError,
    Pose,
    UngroundedError,
    UnsafeError,
    matrix_from_quaternion,
    matrix_from_rotvec,
    rotvec_from_matrix,
)

Meaning = Literal["delta", "absolute"]
FrameName = Literal["base", "tcp"]
Rotation = Literal["rotvec", "rpy"]
Gripper = Literal["open_fraction", "closed_fraction", "signed_close", "signed_open"]


@dataclass(frozen=True, kw_only=True, slots=True)
class ActionLayout:
    """Seven values a step: translation (3), rotation (3), gripper (1), in the checkpoint's own
    convention.

    Attributes:
        meaning: "delta" moves the TCP by the values; "absolute" gives its target pose.
        frame: axes of a delta: the robot's base, or the TCP at the start of the step.
        rotation: "rotvec", or "rpy" (fixed axes x, y, z).
        translation_scale_m: metres per unit.
        rotation_scale_rad: radians per unit.
        limit: the first six values are clipped to -limit..limit before scaling, as the training
            environment does; 0 for no clipping.
        adds_state: the first six values are relative to the first six of the state, which is added
            first.
        gripper: "open_fraction" 0 closed..1 open, "closed_fraction", "signed_close" -1 open..1
            closed, "signed_open".
        step_s: time between two actions [s].
    """

    meaning: Meaning
    frame: FrameName
    rotation: Rotation
    gripper: Gripper
    step_s: float
    translation_scale_m: float = 1.0
    rotation_scale_rad: float = 1.0
    limit: float = 0.0
    adds_state: bool = False

    def to_contract(self, raw: F64, *, state: F64, pose: Pose | None, base_position_m: F64) -> F64:
        """Convert the checkpoint's actions (H, 7) to the contract's (H, 7): base-frame deltas [m,
        rad] and opening 0..1.

        Args:
            raw: float64 (H, 7), un-normalised.
            state: the state of the same observation, in the training data's units.
            pose: measured TCP pose; needed for "absolute" and for frame "tcp".
            base_position_m: float64 (3,), position of the base in the frame of absolute positions.

        Raises:
            UnsafeError: a value is not finite.
            UngroundedError: the pose is needed and missing.
            ConfigurationError: the rows do not hold 7 values.
        """
        _check_raw(raw)
        moves = raw[:, :6] + state[:6] if self.adds_state else raw[:, :6]
        if self.limit:
            moves = np.clip(moves, -self.limit, self.limit)
        translations, rotations = (
            moves[:, :3] * self.translation_scale_m,
            moves[:, 3:] * self.rotation_scale_rad,
        )
        out = np.empty((len(raw), ACTION_SIZE))
        if self.meaning == "delta" and self.frame == "base":
            out[:, :3], out[:, 3:6] = translations, self._rotation_vectors(rotations)
        else:
            self._follow(out, translations, rotations, self._needed(pose), base_position_m)
        out[:, 6] = np.clip(self._opening(raw[:, 6]), 0.0, 1.0)
        return out

    def from_contract(
        self, actions: F64, *, state: F64, pose: Pose | None, base_position_m: F64
    ) -> F64:
        """The inverse of `to_contract`, for values inside `limit`: converts contract actions (H, 7)
        to the checkpoint's (H, 7).
        """
        raw = np.empty((len(actions), ACTION_SIZE))
        position, rotation = np.zeros(3), np.eye(3)
        if self.meaning == "absolute" or self.frame == "tcp":
            start = self._needed(pose)
            position, rotation = start.position_m, matrix_from_quaternion(start.quaternion_xyzw)
        for row, action in zip(raw, actions, strict=True):
            delta, turn = action[:3], matrix_from_rotvec(action[3:6])
            if self.meaning == "absolute":
                position, rotation = position + delta, turn @ rotation
                row[:3], row[3:6] = position + base_position_m, self._values(rotation)
            elif self.frame == "tcp":
                local = rotation.T @ turn @ rotation
                row[:3], row[3:6] = rotation.T @ delta, self._values(local)
                rotation = rotation @ local
            else:
                row[:3], row[3:6] = delta, self._values(turn)
        raw[:, :3] /= self.translation_scale_m
        raw[:, 3:6] /= self.rotation_scale_rad
        if self.adds_state:
            raw[:, :6] -= state[:6]
        raw[:, 6] = self._gripper_value(actions[:, 6])
        return raw

    def _rotation_vectors(self, rotations: F64) -> F64:
        """Rotation vectors (H, 3) of the checkpoint's rotations (H, 3); rotation vectors up to pi
        long stay unchanged.
        """
        if self.rotation == "rotvec" and (np.linalg.norm(rotations, axis=1) <= np.pi).all():
            return rotations
        return np.array([rotvec_from_matrix(self._matrix(rotation)) for rotation in rotations])

    def _follow(
        self, out: F64, translations: F64, rotations: F64, pose: Pose, base_position_m: F64
    ) -> None:
        """Write base-frame deltas into `out`; each starts at the target of the one before it, the
        first at `pose`.
        """
        position, orientation = pose.position_m, matrix_from_quaternion(pose.quaternion_xyzw)
        for row, translation, rotation in zip(out, translations, rotations, strict=True):
            matrix = self._matrix(rotation)
            if self.meaning == "absolute":
                target = translation - base_position_m
                row[:3], row[3:6] = target - position, rotvec_from_matrix(matrix @ orientation.T)
                position, orientation = target, matrix
            else:
                row[:3], row[3:6] = (
                    orientation @ translation,
                    orientation @ rotvec_from_matrix(matrix),
                )
                orientation = orientation @ matrix

    def _matrix(self, rotation: F64) -> F64:
        return (
            matrix_from_rotvec(rotation) if self.rotation == "rotvec" else matrix_from_rpy(rotation)
        )

    def _values(self, matrix: F64) -> F64:
        return rotvec_from_matrix(matrix) if self.rotation == "rotvec" else rpy_from_matrix(matrix)

    def _needed(self, pose: Pose | None) -> Pose:
        if pose is None:
            raise UngroundedError(
                f"Actions of kind {self.meaning!r} in frame {self.frame!r} need the measured TCP "
                "pose; it comes from "
                "the topic ee_pose, which control publishes."
            )
        return pose

    def _opening(self, value: F64) -> F64:
        if self.gripper == "open_fraction":
            return value
        if self.gripper == "closed_fraction":
            return 1.0 - value
        sign = -1.0 if self.gripper == "signed_close" else 1.0
        return (1.0 + sign * value) / 2.0

    def _gripper_value(self, opening: F64) -> F64:
        if self.gripper == "open_fraction":
            return opening
        if self.gripper == "closed_fraction":
            return 1.0 - opening
        sign = -1.0 if self.gripper == "signed_close" else 1.0
        return sign * (2.0 * opening - 1.0)


def _check_raw(raw: F64) -> None:
    if raw.ndim != 2 or raw.shape[0] < 1 or raw.shape[1] != ACTION_SIZE:
        raise ConfigurationError(
            f"The model yields actions of shape {raw.shape}, expected (H >= 1, {ACTION_SIZE}).",
            hint="Joint-space and two-arm checkpoints cannot be converted to TCP motion.",
        )
    finite = np.isfinite(raw)
    if not finite.all():
        row, column = (int(i) for i in np.argwhere(~finite)[0])
        raise UnsafeError(
            f"The model produced a non-finite value ({raw[row, column]}) at step {row}, column "
            f"{column}."
        )
