"""Actions of move_ee for one arm: a delta for a single arm, or poses of all arms that keep the
others in place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from roboneuron.contract import (
    EE_DELTA,
    Action,
    ControlSpace,
    Pose,
    RobotProfile,
    apply_delta,
    robot_space,
)
from roboneuron.contract.arrays import F64

_AT_ORIGIN = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))


@dataclass(frozen=True, kw_only=True, slots=True)
class Rest:
    """Target of an arm that stays in place while another one moves.

    Attributes:
        pose: pose of its TCP in the base frame.
        opening: opening that keeps its grasp, 0 closed .. 1 open.
    """

    pose: Pose = _AT_ORIGIN
    opening: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ArmRows:
    """Creates rows of the robot's space in which one arm moves.

    Attributes:
        space: `EE_DELTA` for one arm, the robot's `ee_pose` for several.
    """

    space: ControlSpace
    _profile: RobotProfile
    _arm: str
    _rests: Mapping[str, Rest]

    @classmethod
    def of(cls, profile: RobotProfile, arm: str, rests: Mapping[str, Rest]) -> ArmRows:
        """Create the rows for `arm`; `rests` are the poses of all arms at the start of the
        motion.
        """
        space = robot_space("ee_pose", profile) if profile.arms else EE_DELTA
        return cls(space=space, _profile=profile, _arm=arm, _rests=rests)

    def row(self, here: Pose, delta: F64, opening: float) -> F64:
        """Return one row of `space`.

        Args:
            here: TCP of the moving arm, base frame.
            delta: from there, translation [m] and rotation vector [rad], (6,).
            opening: opening of its gripper, 0 closed .. 1 open.
        """
        action = Action(
            translation_m=delta[:3],
            rotation_rad=delta[3:],
            gripper_open=min(1.0, max(0.0, opening)),
        )
        if self.space is EE_DELTA:
            return action.to_vector()
        parts: list[Sequence[float] | F64] = []
        for arm in self._profile.arms:
            rest = self._rests[arm.name]
            pose, hand = rest.pose, rest.opening
            if arm.name == self._arm:
                pose, hand = apply_delta(here, action), action.gripper_open
            parts += [pose.position_m, pose.quaternion_xyzw]
            if arm.gripper is not None:
                parts.append([hand])
        return np.concatenate(parts)


def to_message(space: ControlSpace, row: F64) -> object:
    """Create the message of a row for the topic `action`."""
    from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout  # heavy

    dimension = MultiArrayDimension(label=space.label, size=space.size, stride=space.size)
    return Float64MultiArray(layout=MultiArrayLayout(dim=[dimension]), data=row.tolist())
