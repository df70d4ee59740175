"""Policies that act on joints: what their state and action values mean, and the conversion between
the robot, the network and the contract's units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_backend_pi0 import angular_gripper
from rn_vla.rotation import F64
from roboneuron import GRIPPER, Channel, ConfigurationError, ControlSpace

JointGripper = Literal["open_fraction", "closed_fraction"]
JointKind = Literal["joint_position", "joint_velocity"]


@dataclass(frozen=True, kw_only=True, slots=True)
class JointLayout:
    """Joints and gripper of each arm in turn, as one family of checkpoints has them.

    Attributes:
        kind: "joint_position" [rad] or "joint_velocity" [rad/s].
        joints: per arm, from the base to the tip.
        rate_hz: rows per second that the policy was trained for.
        gripper: 0..1 "open_fraction" 0 closed, "closed_fraction" 0 open; absolute in every kind.
        arms: names of the arms; one empty name for a robot with one arm.
        relative: the network's joints are relative to the state at the chunk's start.
        signs: of each joint of an arm, network against robot; empty for all the same.
        angular: the network's gripper is the angle of ALOHA's motor (see `angular_gripper`).
        limit: joint values are clipped to -limit..limit, as the public client does; 0 for none.
        scale: contract units (rad, rad/s) of one unit of a joint value.
    """

    kind: JointKind
    joints: int
    rate_hz: float
    gripper: JointGripper
    arms: tuple[str, ...] = ("",)
    relative: bool = False
    signs: tuple[int, ...] = ()
    angular: bool = False
    limit: float = 0.0
    scale: float = 1.0

    @property
    def columns(self) -> tuple[str, ...]:
        """What each value is, in order: "joint" or "gripper"."""
        return (*("joint",) * self.joints, "gripper") * len(self.arms)

    @property
    def width(self) -> int:
        """Number of values."""
        return len(self.arms) * (self.joints + 1)

    @property
    def grippers(self) -> NDArray[np.bool_]:
        """bool (width,), True at the grippers."""
        return np.array([column == "gripper" for column in self.columns])

    def space(self, names: Sequence[str]) -> ControlSpace:
        """What the rows are, for a robot whose joints have these names, in the policy's order.

        Raises:
            ConfigurationError: another number of joints.
        """
        count = len(self.arms) * self.joints
        starts = range(0, count, self.joints)
        own = {arm: names[i : i + self.joints] for arm, i in zip(self.arms, starts, strict=True)}
        if len(names) != count or any(len(set(part)) != self.joints for part in own.values()):
            raise ConfigurationError(
                f"The option 'joints' names {len(names)} joints ({', '.join(names)}), the policy "
                f"moves {count}, each of an arm's once.",
                hint="Name them in the policy's order, from the base to the tip of each arm.",
            )
        unit = "rad" if self.kind == "joint_position" else "rad/s"
        channels: list[Channel] = []
        for arm, part in own.items():
            channels += [Channel(name=name, unit=unit, arm=arm) for name in part]
            channels.append(Channel(name=GRIPPER, unit="opening", arm=arm))
        return ControlSpace(kind=self.kind, channels=tuple(channels), rate_hz=self.rate_hz)

    def to_network(self, state: F64) -> F64:
        """float64 (width,) as the robot's own software has it -> what is normalised."""
        out = state * self._flips()
        if self.angular:
            out[self.grippers] = angular_gripper.from_opening(out[self.grippers])
        return out

    def to_robot(self, actions: F64, state: F64) -> F64:
        """Un-normalised actions (H, width) -> what the robot's own software is told.

        Args:
            actions: float64 (H, width).
            state: float64 (width,), `to_network` of the same observation.
        """
        out = actions + np.where(self.grippers, 0.0, state) if self.relative else actions.copy()
        out *= self._flips()
        if self.angular:
            out[:, self.grippers] = angular_gripper.to_opening(out[:, self.grippers])
        return out

    def to_contract(self, actions: F64) -> F64:
        """What the robot's own software is told (H, width) -> rows of `space`: rad or rad/s, and
        openings 0 closed..1 open.
        """
        at = self.grippers
        out = actions * self.scale
        if self.limit:
            out = np.clip(actions, -self.limit, self.limit) * self.scale
        openings = actions[:, at]
        if self.gripper == "closed_fraction":
            openings = 1.0 - openings
        out[:, at] = np.clip(openings, 0.0, 1.0)
        return out

    def _flips(self) -> F64:
        signs = self.signs or (1,) * self.joints
        return np.array((*signs, 1) * len(self.arms), dtype=np.float64)
