"""The robot's measured state as entries of a request: complete and by name between RoboNeuron's
client and server, or as vectors of a profile's terms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rn_backend_openpi.wire import Value
from rn_vla.rotation import DOWN_ROTVEC_RAD, F64, matrix_from_rpy
from rn_vla.tcp_state import StateLayout, StateTerm
from roboneuron import (
    ArmState,
    InvalidInputError,
    JointSample,
    Observation,
    Pose,
    UngroundedError,
    UnsafeError,
    matrix_from_rotvec,
    quaternion_from_matrix,
)

_MOST_JOINTS = 256
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


def state_entries(observation: Observation) -> dict[str, Value]:
    """Encode the complete measured state, by name. Joints are sent with their names; poses as
    x y z qx qy qz qw in the base frame [m, 1]. Raises UnsafeError: a value is not finite.
    """
    entries: dict[str, Value] = {}
    joints = observation.joints
    if joints is not None:
        entries[_NAMES] = list(joints.names)
        entries[_POSITION] = _finite(joints.position, _POSITION)
        if joints.velocity is not None:
            entries[_VELOCITY] = _finite(joints.velocity, _VELOCITY)
    _put(entries, _PREFIX, observation.ee_pose, observation.gripper_open)
    for name, arm in observation.arms.items():
        _put(entries, f"{_PREFIX}{name}/", arm.ee_pose, arm.gripper_open)
    return entries


def _put(entries: dict[str, Value], prefix: str, pose: Pose | None, opening: float | None) -> None:
    if pose is not None:
        values = np.concatenate([pose.position_m, pose.quaternion_xyzw])
        entries[prefix + _POSE] = _finite(values, prefix + _POSE)
    if opening is not None:
        entries[prefix + _GRIPPER] = _finite(np.array([opening]), prefix + _GRIPPER)


def state_of(entries: Mapping[str, object]) -> Measured:
    """The inverse of `state_entries`.

    Raises:
        InvalidInputError: an entry is missing or malformed.
        UnsafeError: a value is not finite.
    """
    arms: dict[str, ArmState] = {}
    for key in map(str, entries):
        arm, _, name = key.removeprefix(_PREFIX).rpartition("/")
        if arm and name == _POSE and key.startswith(_PREFIX):
            pose, opening = _hand(entries, f"{_PREFIX}{arm}/")
            assert pose is not None
            arms[arm] = ArmState(ee_pose=pose, gripper_open=opening)
    pose, opening = _hand(entries, _PREFIX)
    return Measured(joints=_joints(entries), ee_pose=pose, gripper_open=opening, arms=arms)


def _finite(values: F64, key: str) -> F64:
    if not np.isfinite(values).all():
        raise UnsafeError(f"The measured state holds a non-finite value ({key}).")
    return np.asarray(values, dtype=np.float64)


def _vector(entries: Mapping[str, object], key: str, width: int | None = None) -> F64:
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


def _checked_unit(quaternion_xyzw: F64) -> F64:
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
        or len(names) > _MOST_JOINTS
        or not all(isinstance(name, str) for name in names)
        or len(set(names)) != len(names)
    ):
        raise InvalidInputError(f"The request's {_NAMES!r} are no list of distinct names.")
    has_velocity = _VELOCITY in entries
    return JointSample(
        names=tuple(names),
        position=_vector(entries, _POSITION, len(names)),
        velocity=_vector(entries, _VELOCITY, len(names)) if has_velocity else None,
    )


def _hand(entries: Mapping[str, object], prefix: str) -> tuple[Pose | None, float | None]:
    """Pose and opening at the keys with a prefix."""
    pose = opening = None
    if prefix + _POSE in entries:
        values = _vector(entries, prefix + _POSE, 7)
        pose = Pose(position_m=values[:3], quaternion_xyzw=_checked_unit(values[3:]))
    if prefix + _GRIPPER in entries:
        opening = float(_vector(entries, prefix + _GRIPPER, 1)[0])
    return pose, opening


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TermState:
    """Vectors of state terms as used in training; each key holds its terms arm after arm.

    Attributes:
        parts: layout of each arm's values, by key.
    """

    parts: Mapping[str, Mapping[str, StateLayout]]

    @property
    def keys(self) -> tuple[str, ...]:
        """Required keys of a request."""
        return tuple(self.parts)

    def build(self, observation: Observation) -> dict[str, Value]:
        """Create the entries of a request.

        Raises:
            UngroundedError: a needed value is not measured.
            UnsafeError: a value is not finite.
        """
        return {
            key: np.concatenate(
                [layout.build(_of_arm(observation, arm)) for arm, layout in part.items()]
            )
            for key, part in self.parts.items()
        }

    def parse(self, entries: Mapping[str, object]) -> Measured:
        """The inverse of `build`; raises as `state_of`."""
        hands: dict[str, _Hand] = {}
        joints: dict[str, float] = {}
        for key, part in self.parts.items():
            values = _vector(entries, key, sum(layout.width for layout in part.values()))
            for arm, layout in part.items():
                for term in layout.terms:
                    width = replace(layout, terms=(term,)).width
                    found, values = values[:width], values[width:]
                    if term == "joints":
                        joints |= dict(zip(layout.joint_names, found.tolist(), strict=True))
                    hands.setdefault(arm, _Hand()).read(term, found, layout)
        first = next(iter(hands.values()), _Hand())
        return Measured(
            joints=JointSample(names=tuple(joints), position=np.array([*joints.values()]))
            if joints
            else None,
            ee_pose=first.pose,
            gripper_open=first.opening,
            arms={
                name: ArmState(ee_pose=hand.pose or _UNKNOWN, gripper_open=hand.opening)
                for name, hand in hands.items()
                if name
            },
        )


_UNKNOWN = Pose(position_m=np.full(3, np.nan), quaternion_xyzw=np.full(4, np.nan))
"""Pose of an arm for which the request has none: NaN, so that computing with it gives no number."""
_DOWN = matrix_from_rotvec(np.array(DOWN_ROTVEC_RAD))
_QUATERNIONS: Mapping[str, Callable[[F64], F64]] = {
    "quaternion": _checked_unit,
    "rotvec": lambda values: quaternion_from_matrix(matrix_from_rotvec(values)),
    "rpy": lambda values: quaternion_from_matrix(matrix_from_rpy(values)),
    "rpy_by_down": lambda values: quaternion_from_matrix(matrix_from_rpy(values) @ _DOWN),
}
_OPENINGS: Mapping[str, Callable[[float, StateLayout], float]] = {
    "gripper_open": lambda value, layout: value,
    "gripper_closed": lambda value, layout: 1.0 - value,
    "fingers": lambda value, layout: value / layout.finger_travel_m,
}


@dataclass(slots=True)
class _Hand:
    """Pose and opening of one arm, as far as they have been read."""

    position_m: F64 | None = None
    quaternion_xyzw: F64 | None = None
    opening: float | None = None

    @property
    def pose(self) -> Pose | None:
        if self.position_m is None or self.quaternion_xyzw is None:
            return None
        return Pose(position_m=self.position_m, quaternion_xyzw=self.quaternion_xyzw)

    def read(self, term: StateTerm, values: F64, layout: StateLayout) -> None:
        if term == "position":
            self.position_m = values - layout.base_position_m
        elif term in _QUATERNIONS:
            self.quaternion_xyzw = _QUATERNIONS[term](values)
        elif term in _OPENINGS:
            self.opening = float(np.clip(_OPENINGS[term](values[0], layout), 0.0, 1.0))


def _of_arm(observation: Observation, arm: str) -> Observation:
    """The observation with that arm's pose and gripper as those of a single arm."""
    if not arm:
        return observation
    state = observation.arms.get(arm)
    if state is None:
        raise UngroundedError(
            f"The state needs the arm {arm!r}; measured are "
            f"{', '.join(observation.arms) or 'none by name'}.",
            hint="Name the arms like this in the robot's profile, or correct the option 'arms'.",
        )
    return replace(observation, ee_pose=state.ee_pose, gripper_open=state.gripper_open)
