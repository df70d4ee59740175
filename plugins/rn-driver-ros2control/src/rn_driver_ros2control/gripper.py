"""Goals for the gripper: a policy repeats its gripper value with every action, and a new goal each
time would never end.
"""

from __future__ import annotations

from rn_driver_ros2control.link import ControllerLink
from roboneuron import GripperProfile

_SAME_OPENING = 0.02
"""Fraction of the gripper's travel: a smaller change is not a new command, unless it opens or
closes fully.
"""


class GripperGoals:
    """Sends a goal when the wanted opening changes.

    A first command to the present position sends no goal: it would end the force on a held object.
    """

    def __init__(self, profile: GripperProfile | None) -> None:
        self._profile = profile
        self._opening: float | None = None

    def move(self, link: ControllerLink, position: float, measured: float | None = None) -> None:
        """Move to `position` of the gripper's joint [rad or m], unless it was already sent there or
        never left `measured`.
        """
        if self._profile is None:
            return
        opening = self._profile.to_opening(position)
        if self._opening is None and measured is not None:
            if abs(opening - self._profile.to_opening(measured)) <= _SAME_OPENING:
                return
        elif self._opening is not None:
            is_small = abs(opening - self._opening) <= _SAME_OPENING
            if opening == self._opening or (is_small and opening not in (0.0, 1.0)):
                return
        self._opening = opening
        link.move_gripper(self._profile.to_position(opening))
