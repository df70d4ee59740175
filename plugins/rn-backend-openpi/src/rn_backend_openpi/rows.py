"""Conversion of the values of a served row from a policy's convention to the contract's, and
back.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Literal

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


@dataclass(frozen=True, kw_only=True, eq=False)
class DeltaRows:
    """Rows that move the TCP of one arm. Arrays of all rows are float64, openings 0 closed .. 1
    open.

    Attributes:
        layout: meaning of the values.
        base_position_m: position of the robot's base in the frame of the positions.
        space: control space of a row in the contract.
        width: number of values of a served row.
    """

    layout: ActionLayout
    base_position_m: F64
    space: ControlSpace = EE_DELTA
    width: int = ACTION_SIZE

    @property
    def step_s(self) -> float:
        """Time between two rows [s]."""
        return self.layout.step_s

    def to_contract(self, served: F64, observation: Observation) -> F64:
        """Convert served rows (H, width), finite, to rows of `space` (H, n).

        Raises:
            UngroundedError: a measured pose is needed and missing.
            UnsafeError: a row is no rotation.
        """
        return self.layout.to_contract(
            served,
            state=np.zeros(0),
            pose=observation.ee_pose,
            base_position_m=self.base_position_m,
        )

    def from_contract(self, rows: F64, observation: Observation) -> F64:
        """The inverse of `to_contract`, except for clipped values; raises the same errors."""
        return self.layout.from_contract(
            rows,
            state=np.zeros(0),
            pose=observation.ee_pose,
            base_position_m=self.base_position_m,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RowsByArm(ABC):
    """Rows of some values and the gripper of each arm in turn; as `DeltaRows`.

    Attributes:
        kind: of the control space.
        gripper: meaning of an arm's last value; "none" for no gripper.
        rate_hz: rows per second.
        arms: names of the arms; one empty name for a robot with one arm.
    """

    kind: str
    gripper: GripperValue
    rate_hz: float
    arms: tuple[str, ...] = ONE_ARM

    @property
    def space(self) -> ControlSpace:
        """Control space of a row in the contract. Raises ConfigurationError for joints that do not
        fit the arms.
        """
        channels: list[Channel] = []
        for arm in self.arms:
            channels += self._channels(arm)
            if self.gripper != "none":
                channels.append(Channel(name=GRIPPER, unit="opening", arm=arm))
        return ControlSpace(kind=self.kind, channels=tuple(channels), rate_hz=self.rate_hz)

    @property
    def step_s(self) -> float:
        """Time between two rows [s]."""
        return 1.0 / self.rate_hz

    @property
    def width(self) -> int:
        """Number of values of a served row."""
        return len(self.arms) * (self._values + (self.gripper != "none"))

    def to_contract(self, served: F64, observation: Observation) -> F64:
        """See `DeltaRows`."""
        columns: list[F64] = []
        for part in np.split(served, len(self.arms), axis=1):
            values, gripper = np.split(part, [self._values], axis=1)
            columns.append(self._to_contract(values))
            if self.gripper != "none":
                columns.append(np.clip(to_opening(gripper, self.gripper), 0.0, 1.0))
        return np.hstack(columns)

    def from_contract(self, rows: F64, observation: Observation) -> F64:
        """See `DeltaRows`."""
        has_gripper, columns = self.gripper != "none", list[F64]()
        for part in np.split(rows, len(self.arms), axis=1):
            values, openings = np.split(part, [part.shape[1] - has_gripper], axis=1)
            columns.append(self._from_contract(values))
            if has_gripper:
                columns.append(from_opening(openings, self.gripper))
        return np.hstack(columns)

    @property
    @abstractmethod
    def _values(self) -> int:
        """Number of values of one arm, without the gripper."""

    @abstractmethod
    def _channels(self, arm: str) -> list[Channel]:
        """Channels of one arm, without the gripper."""

    @abstractmethod
    def _to_contract(self, values: F64) -> F64: ...

    @abstractmethod
    def _from_contract(self, values: F64) -> F64: ...


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseRows(RowsByArm):
    """Poses of the TCP: position, rotation.

    Attributes:
        rotation: "quaternion" x y z w, "quaternion_wxyz", "rotvec" [rad], "rpy" [rad] about fixed
            axes, "rot6d" the first two columns of the rotation matrix one after the other,
            "rot6d_rows" its first two rows.
        base_position_m: position of the robot's base in the frame of the positions.
    """

    rotation: PoseRotation
    kind: str = "ee_pose"
    base_position_m: F64 = field(default_factory=lambda: np.zeros(3))

    @property
    def _values(self) -> int:
        return 3 + ROTATION_VALUES[self.rotation]

    def _channels(self, arm: str) -> list[Channel]:
        units = {**dict.fromkeys("xyz", "m"), **dict.fromkeys(("qx", "qy", "qz", "qw"), "1")}
        return [Channel(name=x, unit=unit, frame="base", arm=arm) for x, unit in units.items()]

    def _to_contract(self, values: F64) -> F64:
        quaternions = [
            quaternion_from_matrix(matrix_of(row, self.rotation)) for row in values[:, 3:]
        ]
        return np.hstack([values[:, :3] - self.base_position_m, np.array(quaternions)])

    def _from_contract(self, values: F64) -> F64:
        rotations = [rotation_of(row, self.rotation) for row in values[:, 3:]]
        return np.hstack([values[:, :3] + self.base_position_m, np.array(rotations)])


@dataclass(frozen=True, kw_only=True, eq=False)
class JointRows(RowsByArm):
    """Joints of each arm; each has the same number.

    Attributes:
        kind: "joint_position" [rad], "joint_velocity" [rad/s], "joint_delta" [rad] relative to the
            joints measured with the observation; the gripper is absolute in each.
        names: the robot's names of the policy's joints, in the policy's order; empty in a preset.
        limit: joint values are clipped to -limit..limit; 0 for none.
        scale: contract units (rad, rad/s) per unit of a joint value.
    """

    names: tuple[str, ...] = ()
    limit: float = 0.0
    scale: float = 1.0

    @property
    def _values(self) -> int:
        return len(self.names) // len(self.arms)

    def _channels(self, arm: str) -> list[Channel]:
        unit = "rad/s" if self.kind == "joint_velocity" else "rad"
        names = joints_by_arm(self.names, self.arms)[arm]
        return [Channel(name=name, unit=unit, arm=arm) for name in names]

    def _to_contract(self, values: F64) -> F64:
        if self.limit:
            values = np.clip(values, -self.limit, self.limit)
        return values * self.scale

    def _from_contract(self, values: F64) -> F64:
        return values / self.scale


Rows = DeltaRows | RowsByArm
"""Rows of one kind of policy."""


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
