"""Joint policies: meaning of their state and action values, and the conversion between the robot,
the network and the contract's units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rn_vla.joint_rows import PlatformJoints
from rn_vla.rotation import F64

_TRAVEL_M = (0.01844, 0.05800)
"""Position of a finger of the follower arm, closed and open, in the linkage's coordinate."""
_HORN_M = 0.022
_ROD_M = 0.036
"""Radius of the motor's horn and length of the rod to the finger."""
_TRAINED_RAD = (0.5476, 1.6296)
"""Motor angles that pi0's data encodes as 0 and 1: encoder counts 2405 and 3110 of 4096, zero at
2048.
"""
_MOTOR_RAD = (-0.6213, 1.4910)
"""Motor angles that the commands of ALOHA's software encode as 0 and 1."""


@dataclass(frozen=True, kw_only=True, slots=True)
class JointLayout(PlatformJoints):
    """Joints and gripper of each arm in turn, as in one family of checkpoints.

    Attributes:
        relative: the network's joints are relative to the state at the chunk's start.
        signs: sign of each joint of an arm, network relative to robot; empty for equal signs.
        angular: the network's gripper is the angle of ALOHA's motor, see `fraction_of_angle`.
        limit: joint values are clipped to -limit..limit, as in the public client; 0 for none.
        scale: contract units (rad, rad/s) per unit of a joint value.
    """

    relative: bool = False
    signs: tuple[int, ...] = ()
    angular: bool = False
    limit: float = 0.0
    scale: float = 1.0

    def to_network(self, state: F64) -> F64:
        """Convert the state of the robot's own software, float64 (width,), to the network's values
        before normalisation.
        """
        out = state * self._flips()
        if self.angular:
            out[self.grippers] = fraction_of_angle(out[self.grippers])
        return out

    def to_robot(self, actions: F64, state: F64) -> F64:
        """Convert un-normalised actions (H, width) to commands of the robot's own software.

        Args:
            actions: float64 (H, width).
            state: float64 (width,), `to_network` of the same observation.
        """
        out = actions + np.where(self.grippers, 0.0, state) if self.relative else actions.copy()
        out *= self._flips()
        if self.angular:
            out[:, self.grippers] = opening_of_angle(out[:, self.grippers])
        return out

    def to_contract(self, actions: F64) -> F64:
        """Convert commands of the robot's own software (H, width) to rows of `space`: rad or rad/s,
        and openings 0 closed..1 open.
        """
        at = ~self.grippers
        out = actions.copy()
        joints = actions[:, at]
        if self.limit:
            joints = np.clip(joints, -self.limit, self.limit)
        out[:, at] = joints * self.scale
        return PlatformJoints.to_contract(self, out)

    def _flips(self) -> F64:
        signs = self.signs or (1,) * self.joints
        return np.array((*signs, 1) * len(self.arms), dtype=np.float64)


def fraction_of_angle(opening: F64) -> F64:
    """Convert a measured opening, 0 closed..1 open by the finger's travel, to pi0's fraction of the
    motor's angle: ALOHA's own software uses the finger's travel (state) and the fraction of the
    motor's travel (command).

    Source: Interbotix and ALOHA constants, openpi's policy of ALOHA; `tests/data/action-spaces`
    holds its reference values.
    """
    low, high = _TRAVEL_M
    travel_m = opening * (high - low) + low
    # Law of cosines in the triangle of horn, rod and finger.
    cosine = (_HORN_M**2 + travel_m**2 - _ROD_M**2) / (2 * _HORN_M * travel_m)
    angle_rad = np.arcsin(np.clip(cosine, -1.0, 1.0))
    least, most = _TRAINED_RAD
    return np.asarray((angle_rad - least) / (most - least), dtype=np.float64)


def opening_of_angle(value: F64) -> F64:
    """Convert pi0's gripper action [rad above its smallest angle] to ALOHA's command, 0 closed..1
    open.
    """
    least, most = _MOTOR_RAD
    return np.asarray((value + _TRAINED_RAD[0] - least) / (most - least), dtype=np.float64)
