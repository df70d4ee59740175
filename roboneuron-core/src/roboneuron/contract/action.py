"""The action, a 7-vector with the same meaning for every model, and chunks of actions.

dx dy dz [m] and rx ry rz [rad, rotation vector] move the TCP in the robot's base frame (p' = p + d,
R' = exp(r) R); the last value is the absolute gripper opening, 0 closed .. 1 open. A chunk may
contain rows of another, named space instead (see `roboneuron.contract.space`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from roboneuron.contract.arrays import F64, ReadOnly, freeze
from roboneuron.contract.observation import Pose
from roboneuron.contract.rotation import (
    matrix_from_quaternion,
    matrix_from_rotvec,
    quaternion_from_matrix,
)
from roboneuron.contract.space import EE_DELTA, ControlSpace
from roboneuron.errors import InvalidInputError

ACTION_SIZE = EE_DELTA.size
"""Number of values in one action of the default space."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Action(ReadOnly):
    """One step: a TCP delta in the base frame and the absolute gripper opening. Its arrays are
    read-only copies.

    Attributes:
        translation_m: float64 (3,), base frame.
        rotation_rad: float64 (3,), rotation vector in the base frame, applied on the left.
        gripper_open: 0 closed .. 1 open.
    """

    translation_m: F64
    rotation_rad: F64
    gripper_open: float

    @classmethod
    def from_vector(cls, values: ArrayLike) -> Action:
        """Build from 7 values in the order of ACTION_FIELDS; raises as `ControlSpace.check`."""
        v = EE_DELTA.check(values)
        return cls(translation_m=v[:3], rotation_rad=v[3:6], gripper_open=float(v[6]))

    def to_vector(self) -> F64:
        """Return float64 (7,) in the order of ACTION_FIELDS."""
        return np.concatenate([self.translation_m, self.rotation_rad, [self.gripper_open]])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ActionChunk:
    """Result of one inference: H actions, executed one per `step_s`, the first at once.

    Attributes:
        actions: float64 (H, n), H >= 1, n = 7 in the default space, finite, gripper in [0, 1];
            checked at construction, kept as a read-only copy.
        step_s: time between two actions [s], > 0.
        metrics: numbers for /diagnostics and get_status (for instance "tokens_kept").
        note: one short sentence on what the backend is doing, shown to the agent; may be empty.
        context: the backend's own form of the chunk (pi0: normalised actions); returned to it in
            `Ahead.context`, in the same process, never inspected.
        conditioned_rows: number of rows, from row 0 on, that continue `Observation.ahead.rows`, 0
            .. H. If it is not 0, there is no cross-fade.
        space: meaning of a row's values; the one that the backend's descriptor declares.

    Raises:
        InvalidInputError, UnsafeError: as `ControlSpace.check`, or when the shape is not (H, n).
    """

    actions: F64
    step_s: float
    metrics: Mapping[str, float] = field(default_factory=dict)
    note: str = ""
    context: Any = None
    conditioned_rows: int = 0
    space: ControlSpace = EE_DELTA

    def __post_init__(self) -> None:
        actions = np.asarray(self.actions, dtype=np.float64)
        if actions.ndim != 2 or actions.shape[0] < 1 or actions.shape[1] != self.space.size:
            raise InvalidInputError(
                f"A chunk has shape {actions.shape}, expected (H >= 1, {self.space.size})."
            )
        for row in actions:
            self.space.check(row)
        if not (np.isfinite(self.step_s) and self.step_s > 0):
            raise InvalidInputError(
                f"step_s is {self.step_s}, expected a finite number of seconds > 0."
            )
        if not 0 <= self.conditioned_rows <= len(actions):
            raise InvalidInputError(
                f"conditioned_rows is {self.conditioned_rows}, the chunk has {len(actions)} rows."
            )
        freeze(self, "actions")
        object.__setattr__(self, "metrics", dict(self.metrics))


def apply_delta(pose: Pose, action: Action) -> Pose:
    """Return the TCP pose after `action`: p' = p + d, R' = exp(r) R, both in the base frame."""
    rotation = matrix_from_rotvec(action.rotation_rad) @ matrix_from_quaternion(
        pose.quaternion_xyzw
    )
    return Pose(
        position_m=pose.position_m + action.translation_m,
        quaternion_xyzw=quaternion_from_matrix(rotation),
        stamp_ns=pose.stamp_ns,
    )
