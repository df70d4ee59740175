"""The measured state as entries of a request, complete and by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rn_backend_openpi.wire import Value
from roboneuron import (
    ArmState,
    InvalidInputError,
    JointSample,
    Observation,
    Pose,
    UngroundedError,
    UnsafeError,
)

F64 = NDArray[np.float64]
MOST_JOINTS = 256
_ROUNDED = 1e-3
"""Tolerance of a quaternion's length, for rounding to float32 or a few decimals."""
_NAMES, _POSITION = "observation/joint_names", "observation/joint_position"
_VELOCITY = "observation/joint_velocity"
_POSE, _GRIPPER = "ee_pose", "gripper_open"
_PREFIX = "observation/"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Measured:
    """The robot's state in a request; None or empty for missing entries."""

    joints: JointSample | None = None
    ee_pose: Pose | None = None
    gripper_open: float | None = None
    arms: Mapping[str, ArmState] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class WholeState:
    """The complete measured state, by name, between RoboNeuron's client and RoboNeuron's server.

    Joints are sent with their names; poses as x y z qx qy qz qw in the base frame [m, 1].
    """

    keys: tuple[str, ...] = ()

    def build(self, observation: Observation) -> dict[str, Value]:
        entries: dict[str, Value] = {}
        joints = observation.joints
        if joints is not None:
            entries[_NAMES] = list(joints.names)
            entries[_POSITION] = _finite(joints.position, _POSITION)
            if joints.velocity is not None:
                entries[_VELOCITY] = _finite(joints.velocity, _VELOCITY)
        self._put(entries, _PREFIX, observation.ee_pose, observation.gripper_open)
        for name, arm in observation.arms.items():
            self._put(entries, f"{_PREFIX}{name}/", arm.ee_pose, arm.gripper_open)
        if not entries:
            raise UngroundedError("The observation holds no measured state to send to the server.")
        return entries

    @staticmethod
    def _put(
        entries: dict[str, Value], prefix: str, pose: Pose | None, opening: float | None
    ) -> None:
        if pose is not None:
            values = np.concatenate([pose.position_m, pose.quaternion_xyzw])
            entries[prefix + _POSE] = _finite(values, prefix + _POSE)
        if opening is not None:
            entries[prefix + _GRIPPER] = _finite(np.array([opening]), prefix + _GRIPPER)

    def parse(self, entries: Mapping[str, object]) -> Measured:
        arms: dict[str, ArmState] = {}
        for key in entries:
            arm, _, name = str(key).removeprefix(_PREFIX).rpartition("/")
            if arm and name == _POSE and str(key).startswith(_PREFIX):
                pose = _pose(entries, f"{_PREFIX}{arm}/")
                assert pose is not None
                arms[arm] = ArmState(
                    ee_pose=pose, gripper_open=_opening(entries, f"{_PREFIX}{arm}/")
                )
        return Measured(
            joints=_joints(entries),
            ee_pose=_pose(entries, _PREFIX),
            gripper_open=_opening(entries, _PREFIX),
            arms=arms,
        )


def _finite(values: F64, key: str) -> F64:
    if not np.isfinite(values).all():
        raise UnsafeError(f"The measured state holds a non-finite value ({key}).")
    return np.asarray(values, dtype=np.float64)


def vector_of(entries: Mapping[str, object], key: str, width: int | None = None) -> F64:
    """float64 (width,) of an entry. Raises InvalidInputError, UnsafeError."""
    value = entries.get(key)
    if not isinstance(value, np.ndarray | np.generic | float | int):
        has = "is missing" if value is None else f"is a {type(value).__name__}"
        raise InvalidInputError(f"The request's {key!r} {has}; expected numbers.")
    numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if numbers.ndim != 1 or (width is not None and numbers.shape != (width,)):
        wanted = "n" if width is None else width
        raise InvalidInputError(
            f"The request's {key!r} has the shape {numbers.shape}, expected ({wanted},)."
        )
    if not np.isfinite(numbers).all():
        raise UnsafeError(f"The request's {key!r} holds a non-finite value.")
    return numbers


def checked_unit(quaternion_xyzw: F64) -> F64:
    """Return the quaternion. Raises InvalidInputError unless its length is 1."""
    length = math.hypot(*quaternion_xyzw.tolist())
    if abs(length - 1.0) > _ROUNDED:
        raise InvalidInputError(f"The request's quaternion has the length {length:.4g}, not 1.")
    return quaternion_xyzw


def _joints(entries: Mapping[str, object]) -> JointSample | None:
    names = entries.get(_NAMES)
    if names is None:
        return None
    if (
        not isinstance(names, Sequence)
        or len(names) > MOST_JOINTS
        or not all(isinstance(name, str) for name in names)
        or len(set(names)) != len(names)
    ):
        raise InvalidInputError(f"The request's {_NAMES!r} are no list of distinct names.")
    has_velocity = _VELOCITY in entries
    return JointSample(
        names=tuple(names),
        position=vector_of(entries, _POSITION, len(names)),
        velocity=vector_of(entries, _VELOCITY, len(names)) if has_velocity else None,
    )


def _pose(entries: Mapping[str, object], prefix: str) -> Pose | None:
    if prefix + _POSE not in entries:
        return None
    values = vector_of(entries, prefix + _POSE, 7)
    return Pose(position_m=values[:3], quaternion_xyzw=checked_unit(values[3:]))


def _opening(entries: Mapping[str, object], prefix: str) -> float | None:
    if prefix + _GRIPPER not in entries:
        return None
    return float(vector_of(entries, prefix + _GRIPPER, 1)[0])
