"""Conversion of the values of a served row from a policy's convention to the contract's, and
back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from rn_backend_openpi.conventions import (
    ROTATION_VALUES,
    GripperValue,
    PoseRotation,
    from_opening,
    matrix_of,
    rotation_of,
    to_opening,
)
from rn_vla.rotation import F64
from rn_vla.tcp_actions import ActionLayout
from roboneuron import (
    ACTION_SIZE,
    EE_DELTA,
    GRIPPER,
    Channel,
    ConfigurationError,
    ControlSpace,
    Observation,
    quaternion_from_matrix,
)

JointKind = Literal["joint_position", "joint_velocity", "joint_delta"]
ONE_ARM = ("",)


class Rows(Protocol):
    """Rows of one kind of policy. Arrays are float64, openings 0 closed .. 1 open."""

    @property
    def space(self) -> ControlSpace:
        """Control space of a row in the contract."""

    @property
    def step_s(self) -> float:
        """Time between two rows [s]."""

    @property
    def width(self) -> int:
        """Number of values of a served row."""

    def to_contract(self, served: F64, observation: Observation) -> F64:
        """Convert served rows (H, width), finite, to rows of `space` (H, n).

        Raises:
            UngroundedError: a measured pose is needed and missing.
            UnsafeError: a row is no rotation.
        """

    def from_contract(self, rows: F64, observation: Observation) -> F64:
        """The inverse of `to_contract`, except for clipped values; raises the same errors."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class DeltaRows:
    """Rows that move the TCP of one arm."""

    layout: ActionLayout
    base_position_m: F64

    @property
    def space(self) -> ControlSpace:
        return EE_DELTA

    @property
    def step_s(self) -> float:
        return self.layout.step_s

    @property
    def width(self) -> int:
        return ACTION_SIZE

    def to_contract(self, served: F64, observation: Observation) -> F64:
        return self.layout.to_contract(
            served,
            state=np.zeros(0),
            pose=observation.ee_pose,
            base_position_m=self.base_position_m,
        )

    def from_contract(self, rows: F64, observation: Observation) -> F64:
        return self.layout.from_contract(
            rows,
            state=np.zeros(0),
            pose=observation.ee_pose,
            base_position_m=self.base_position_m,
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PoseRows:
    """Poses of the TCP, arm after arm: position, rotation, gripper.

    Attributes:
        rotation: "quaternion" x y z w, "quaternion_wxyz", "rotvec" [rad], "rpy" [rad] about fixed
            axes, "rot6d" the first two columns of the rotation matrix one after the other,
            "rot6d_rows" its first two rows.
        gripper: meaning of an arm's last value; "none" for no gripper.
        rate_hz: rows per second.
        arms: names of the arms; one empty name for a robot with one arm.
        base_position_m: position of the robot's base in the frame of the positions.
    """

    rotation: PoseRotation
    gripper: GripperValue
    rate_hz: float
    base_position_m: F64
    arms: tuple[str, ...] = ONE_ARM

    @property
    def space(self) -> ControlSpace:
        return ControlSpace(
            kind="ee_pose",
            channels=_pose_channels(self.arms, has_gripper=self.gripper != "none"),
            rate_hz=self.rate_hz,
        )

    @property
    def step_s(self) -> float:
        return 1.0 / self.rate_hz

    @property
    def width(self) -> int:
        return len(self.arms) * self._part

    @property
    def _part(self) -> int:
        """Number of values of one arm."""
        return 3 + ROTATION_VALUES[self.rotation] + (self.gripper != "none")

    def to_contract(self, served: F64, observation: Observation) -> F64:
        parts = np.split(served, len(self.arms), axis=1)
        return np.hstack([self._to_contract(part) for part in parts])

    def _to_contract(self, part: F64) -> F64:
        end = 3 + ROTATION_VALUES[self.rotation]
        quaternions = [
            quaternion_from_matrix(matrix_of(row, self.rotation)) for row in part[:, 3:end]
        ]
        columns = [part[:, :3] - self.base_position_m, np.array(quaternions)]
        if self.gripper != "none":
            columns.append(np.clip(to_opening(part[:, end:], self.gripper), 0.0, 1.0))
        return np.hstack(columns)

    def from_contract(self, rows: F64, observation: Observation) -> F64:
        parts = np.split(rows, len(self.arms), axis=1)
        return np.hstack([self._from_contract(part) for part in parts])

    def _from_contract(self, part: F64) -> F64:
        rotations = [rotation_of(row, self.rotation) for row in part[:, 3:7]]
        columns = [part[:, :3] + self.base_position_m, np.array(rotations)]
        if self.gripper != "none":
            columns.append(from_opening(part[:, 7:], self.gripper))
        return np.hstack(columns)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class JointRows:
    """Joints and gripper of each arm in turn.

    Attributes:
        kind: "joint_position" [rad], "joint_velocity" [rad/s], "joint_delta" [rad] relative to the
            joints measured with the observation; the gripper is absolute in each.
        names: the robot's names of the policy's joints, in the policy's order; empty in a preset.
        gripper: as of `PoseRows`.
        rate_hz: rows per second.
        arms: as of `PoseRows`; each has the same number of joints.
        limit: joint values are clipped to -limit..limit; 0 for none.
        scale: contract units (rad, rad/s) per unit of a joint value.
    """

    kind: JointKind
    gripper: GripperValue
    rate_hz: float
    names: tuple[str, ...] = ()
    arms: tuple[str, ...] = ONE_ARM
    limit: float = 0.0
    scale: float = 1.0

    @property
    def space(self) -> ControlSpace:
        return ControlSpace(
            kind=self.kind,
            channels=_joint_channels(
                self.kind, self.names, self.arms, has_gripper=self.gripper != "none"
            ),
            rate_hz=self.rate_hz,
        )

    @property
    def step_s(self) -> float:
        return 1.0 / self.rate_hz

    @property
    def width(self) -> int:
        return len(self.names) + len(self.arms) * (self.gripper != "none")

    def to_contract(self, served: F64, observation: Observation) -> F64:
        rows, at = served.copy(), self._grippers()
        joints = served[:, ~at]
        if self.limit:
            joints = np.clip(joints, -self.limit, self.limit)
        rows[:, ~at] = joints * self.scale
        rows[:, at] = np.clip(to_opening(served[:, at], self.gripper), 0.0, 1.0)
        return rows

    def from_contract(self, rows: F64, observation: Observation) -> F64:
        served, at = rows.copy(), self._grippers()
        served[:, ~at] = rows[:, ~at] / self.scale
        served[:, at] = from_opening(rows[:, at], self.gripper)
        return served

    def _grippers(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """bool (width,), True at the grippers."""
        joints = len(self.names) // len(self.arms)
        arm = [False] * joints + [True] * (self.gripper != "none")
        return np.array(arm * len(self.arms))


def joints_by_arm(names: tuple[str, ...], arms: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Joint names by arm, in the order of the arms.

    Raises:
        ConfigurationError: they cannot be divided evenly, or a name is repeated.
    """
    each, rest = divmod(len(names), len(arms))
    if rest or not each or len(set(names)) != len(names):
        raise ConfigurationError(
            f"The option 'joints' names {len(names)} joints ({', '.join(names) or 'none'}) for "
            f"{len(arms)} arm(s); each arm needs the same number, and each joint appears once.",
            hint="Name them in the policy's order, from the base to the tip of each arm.",
        )
    return {arm: names[i * each : (i + 1) * each] for i, arm in enumerate(arms)}


def _joint_channels(
    kind: str, names: tuple[str, ...], arms: tuple[str, ...], *, has_gripper: bool
) -> tuple[Channel, ...]:
    """Channels of joints and gripper of each arm in turn. Raises as `joints_by_arm`."""
    unit = "rad/s" if kind == "joint_velocity" else "rad"
    channels: list[Channel] = []
    for arm, part in joints_by_arm(names, arms).items():
        channels += [Channel(name=name, unit=unit, arm=arm) for name in part]
        if has_gripper:
            channels.append(Channel(name=GRIPPER, unit="opening", arm=arm))
    return tuple(channels)


def _pose_channels(arms: tuple[str, ...], *, has_gripper: bool) -> tuple[Channel, ...]:
    """Channels of the pose and gripper of each arm in turn."""
    channels: list[Channel] = []
    for arm in arms:
        channels += [Channel(name=x, unit="m", frame="base", arm=arm) for x in "xyz"]
        channels += [Channel(name=f"q{x}", unit="1", frame="base", arm=arm) for x in "xyzw"]
        if has_gripper:
            channels.append(Channel(name=GRIPPER, unit="opening", arm=arm))
    return tuple(channels)
