"""Proprioception: conversion of the robot's measurements to the state vector of the training data.
No value is invented.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rn_vla.rotation import F64, nearer_rotvec, rpy_by_down, rpy_from_matrix
from roboneuron import (
    Observation,
    Pose,
    UngroundedError,
    UnsafeError,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotvec_from_matrix,
)

StateTerm = Literal[
    "position",
    "rotvec",
    "rpy",
    "rpy_by_down",
    "quaternion",
    "joints",
    "gripper_open",
    "gripper_closed",
    "fingers",
    "padding",
]
_WIDTHS = {"position": 3, "rotvec": 3, "rpy": 3, "rpy_by_down": 3, "quaternion": 4, "fingers": 2}
_POSE_TERMS = frozenset({"position", "rotvec", "rpy", "rpy_by_down", "quaternion"})
_GRIPPER_TERMS = frozenset({"gripper_open", "gripper_closed", "fingers"})


def _zeros() -> F64:
    return np.zeros(3)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class StateLayout:
    """Parts of a state vector, in order.

    Attributes:
        terms: "position" [m], "rotvec" [rad], "rpy" [rad], "rpy_by_down" [rad] (relative to a
            gripper that points down), "quaternion" (x y z w, w >= 0) of the TCP; "joints" [rad, m]
            by `joint_names`; "gripper_open" 0..1, "gripper_closed" 1 - open; "fingers" two finger
            joints +q, -q [m]; "padding" one column that is 0 in the training data.
        joint_names: joints of the term "joints", in order.
        base_position_m: float64 (3,), position of the robot's base in the frame of the training
            data's positions.
        rotvec_near_rad: float64 (3,); a rotation has two rotation vectors (r and r (|r| - 2 pi) /
            |r|), and the one nearer to this is used, so that a gripper pointing down does not
                flip between them.
        finger_travel_m: joint position of one finger when open.
    """

    terms: tuple[StateTerm, ...]
    joint_names: tuple[str, ...] = ()
    base_position_m: F64 = field(default_factory=_zeros)
    rotvec_near_rad: F64 = field(default_factory=_zeros)
    finger_travel_m: float = 0.04

    @property
    def width(self) -> int:
        """Number of values."""
        return len(self.columns)

    @property
    def columns(self) -> tuple[str, ...]:
        """The term of each value."""
        counts = {"joints": len(self.joint_names), **_WIDTHS}
        return tuple(term for term in self.terms for _ in range(counts.get(term, 1)))

    def build(self, observation: Observation) -> F64:
        """The state vector, float64 (width,), in the training data's units.

        Raises:
            UngroundedError: the observation lacks an input of a term; the message names it and its
                source.
            UnsafeError: a measured value is not finite.
        """
        state = np.concatenate([self._term(term, observation) for term in self.terms])
        if not np.isfinite(state).all():
            raise UnsafeError(
                f"The measured state holds a non-finite value: {state.tolist()} "
                f"({', '.join(self.terms)})."
            )
        return state

    def _term(self, term: StateTerm, observation: Observation) -> F64:
        if term in _POSE_TERMS:
            if observation.ee_pose is None:
                raise UngroundedError(
                    _absent(term, "the TCP pose", "the topic ee_pose, which control publishes")
                )
            return self._pose_term(term, observation.ee_pose)
        if term in _GRIPPER_TERMS:
            if observation.gripper_open is None:
                raise UngroundedError(
                    _absent(term, "the gripper's opening", "joint_states with the gripper's joint")
                )
            opening = observation.gripper_open
            if term == "fingers":
                return np.array([opening * self.finger_travel_m, -opening * self.finger_travel_m])
            return np.array([opening if term == "gripper_open" else 1.0 - opening])
        if term == "joints":
            return self._joints(observation)
        return np.zeros(1)

    def _pose_term(self, term: StateTerm, pose: Pose) -> F64:
        if term == "position":
            return np.asarray(pose.position_m + self.base_position_m, dtype=np.float64)
        rotation = matrix_from_quaternion(pose.quaternion_xyzw)
        if term == "rpy":
            return rpy_from_matrix(rotation)
        if term == "rpy_by_down":
            return rpy_by_down(rotation)
        if term == "quaternion":
            return quaternion_from_matrix(rotation)
        return nearer_rotvec(rotvec_from_matrix(rotation), self.rotvec_near_rad)

    def _joints(self, observation: Observation) -> F64:
        joints = observation.joints
        if joints is None:
            raise UngroundedError(
                _absent("joints", "joint states", "the topic joint_states of the robot")
            )
        absent = [name for name in self.joint_names if name not in joints.names]
        if absent:
            raise UngroundedError(
                f"The state needs the joints {', '.join(absent)}, measured are "
                f"{', '.join(joints.names)}.",
                hint="Correct joint_names in the options.",
            )
        return np.array(
            [joints.position[joints.names.index(name)] for name in self.joint_names],
            dtype=np.float64,
        )


def _absent(term: str, what: str, provider: str) -> str:
    return (
        f"The state's {term!r} needs {what}, and the observation has none; it comes from "
        f"{provider}."
    )
