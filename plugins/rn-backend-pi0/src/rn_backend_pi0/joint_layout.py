"""Joint policies: meaning of their state and action values, and the conversion between the robot,
the network and the contract's units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rn_backend_pi0 import angular_gripper
from rn_vla.joint_rows import PlatformJoints
from rn_vla.rotation import F64


@dataclass(frozen=True, kw_only=True, slots=True)
class JointLayout(PlatformJoints):
    """Joints and gripper of each arm in turn, as in one family of checkpoints.

    Attributes:
        relative: the network's joints are relative to the state at the chunk's start.
        signs: sign of each joint of an arm, network relative to robot; empty for equal signs.
        angular: the network's gripper is the angle of ALOHA's motor (see `angular_gripper`).
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
            out[self.grippers] = angular_gripper.from_opening(out[self.grippers])
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
            out[:, self.grippers] = angular_gripper.to_opening(out[:, self.grippers])
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
