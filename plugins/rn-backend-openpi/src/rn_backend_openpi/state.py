"""Conversion of a robot's measured state to the entries of a request, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from rn_backend_openpi.whole_state import Measured, checked_unit, vector_of
from rn_backend_openpi.wire import Value
from rn_vla.rotation import DOWN_ROTVEC_RAD, F64, matrix_from_rpy
from rn_vla.tcp_state import StateLayout, StateTerm
from roboneuron import (
    ArmState,
    JointSample,
    Observation,
    Pose,
    UngroundedError,
    matrix_from_rotvec,
    quaternion_from_matrix,
)


class StateCodec(Protocol):
    """Encoding of the measured state in one profile."""

    @property
    def keys(self) -> tuple[str, ...]:
        """Required keys of a request."""

    def build(self, observation: Observation) -> dict[str, Value]:
        """Create the entries of a request.

        Raises:
            UngroundedError: a needed value is not measured.
            UnsafeError: a value is not finite.
        """

    def parse(self, entries: Mapping[str, object]) -> Measured:
        """The inverse of `build`.

        Args:
            entries: entries of the request, by key.

        Raises:
            InvalidInputError: an entry is missing or malformed.
            UnsafeError: a value is not finite.
        """


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TermState:
    """Vectors of state terms as used in training; each key holds its terms arm after arm.

    Attributes:
        parts: layout of each arm's values, by key.
    """

    parts: Mapping[str, Mapping[str, StateLayout]]

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(self.parts)

    def build(self, observation: Observation) -> dict[str, Value]:
        return {
            key: np.concatenate(
                [layout.build(_of_arm(observation, arm)) for arm, layout in part.items()]
            )
            for key, part in self.parts.items()
        }

    def parse(self, entries: Mapping[str, object]) -> Measured:
        found: dict[str, _Found] = {}
        for key, part in self.parts.items():
            values = vector_of(entries, key, sum(layout.width for layout in part.values()))
            start = 0
            for arm, layout in part.items():
                end = start + layout.width
                found.setdefault(arm, _Found()).read(layout, values[start:end])
                start = end
        first = next(iter(found.values()), _Found())
        names = [name for arm in found.values() for name in arm.joints]
        joints = [value for arm in found.values() for value in arm.joints.values()]
        arms = {
            name: ArmState(ee_pose=arm.pose or _UNKNOWN, gripper_open=arm.opening)
            for name, arm in found.items()
            if name
        }
        return Measured(
            joints=JointSample(names=tuple(names), position=np.array(joints)) if names else None,
            ee_pose=first.pose,
            gripper_open=first.opening,
            arms=arms,
        )


_UNKNOWN = Pose(position_m=np.full(3, np.nan), quaternion_xyzw=np.full(4, np.nan))
"""Pose of an arm for which the request has none: NaN, so that computing with it gives no number."""


@dataclass(slots=True)
class _Found:
    """Values read for one arm so far."""

    joints: dict[str, float] = field(default_factory=dict)
    position_m: F64 | None = None
    quaternion_xyzw: F64 | None = None
    opening: float | None = None

    @property
    def pose(self) -> Pose | None:
        if self.position_m is None or self.quaternion_xyzw is None:
            return None
        return Pose(position_m=self.position_m, quaternion_xyzw=self.quaternion_xyzw)

    def read(self, layout: StateLayout, values: F64) -> None:
        start = 0
        for term in layout.terms:
            width = replace(layout, terms=(term,)).width
            self._term(layout, term, values[start : start + width])
            start += width

    def _term(self, layout: StateLayout, term: StateTerm, values: F64) -> None:
        if term == "position":
            self.position_m = values - layout.base_position_m
        elif term == "quaternion":
            self.quaternion_xyzw = checked_unit(values)
        elif term == "rotvec":
            self.quaternion_xyzw = quaternion_from_matrix(matrix_from_rotvec(values))
        elif term == "rpy":
            self.quaternion_xyzw = quaternion_from_matrix(matrix_from_rpy(values))
        elif term == "rpy_by_down":
            down = matrix_from_rotvec(np.array(DOWN_ROTVEC_RAD))
            self.quaternion_xyzw = quaternion_from_matrix(matrix_from_rpy(values) @ down)
        elif term == "joints":
            self.joints |= dict(zip(layout.joint_names, values.tolist(), strict=True))
        elif term == "fingers":
            self.opening = float(np.clip(values[0] / layout.finger_travel_m, 0.0, 1.0))
        elif term in ("gripper_open", "gripper_closed"):
            opening = values[0] if term == "gripper_open" else 1.0 - values[0]
            self.opening = float(np.clip(opening, 0.0, 1.0))


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
