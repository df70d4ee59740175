"""Comparison of a controller in shadow with its predecessor, on the same actions and joint
states.
"""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Mapping

from roboneuron.contract import Hold, JointCommand, Pose
from roboneuron.gate.motion import task_space
from roboneuron.modules.status import StatusWriter

_POSES = 64
"""Number of own poses kept until the predecessor's for the same joint state arrives: half a
second.
"""
_PAIR_S = 0.08
"""Largest time between the two answers to one action; actions are farther apart."""
_RECENT = 5


class ControllerComparison:
    """Comparison of two controllers; runs on the executor's thread.

    The status contains `shadow_tcp_difference` (of the two TCP poses for one joint state [m or
    rad]), `shadow_count` (answers to actions), `shadow_difference` (median of the largest
    difference of a joint between the two answers to an action [rad or m]) and `shadow_hold`, the
    reason if the newest answer is a hold.
    """

    def __init__(self, status: StatusWriter) -> None:
        self._status = status
        self._poses: deque[Pose] = deque(maxlen=_POSES)
        self._own: tuple[float, Mapping[str, float]] | None = None
        self._other: tuple[float, Mapping[str, float]] | None = None
        self._differences: deque[float] = deque(maxlen=_RECENT)
        self._count = 0

    def answer(self, output: JointCommand | Hold | Pose) -> None:
        """Record an answer of this controller."""
        if isinstance(output, Pose):
            self._poses.append(output)
            return
        self._count += 1
        self._status.set_value("shadow_count", self._count)
        if isinstance(output, Hold):
            self._status.set_value("shadow_hold", f"{output.code}: {output.reason}")
            self._own = None
            return
        self._status.set_value("shadow_hold", "")
        self._own = (time.monotonic(), _positions(output))
        self._compare()

    def hear(self, output: JointCommand | Pose, sent_s: float) -> None:
        """Record an output of the predecessor and its time [monotonic s]."""
        if isinstance(output, JointCommand):
            self._other = (sent_s, _positions(output))
            self._compare()
            return
        mine = next((pose for pose in self._poses if pose.stamp_ns == output.stamp_ns), None)
        if mine is not None:
            difference = max(
                task_space.distance_m(mine, output), task_space.angle_rad(mine, output)
            )
            self._status.set_value("shadow_tcp_difference", round(difference, 9))

    def _compare(self) -> None:
        """Compare two answers that come at about the same time, in any order, and so belong to one
        action.
        """
        if self._own is None or self._other is None or abs(self._own[0] - self._other[0]) > _PAIR_S:
            return
        mine, other = self._own[1], self._other[1]
        self._own = self._other = None
        shared = mine.keys() & other.keys()
        if shared:
            self._differences.append(max(abs(mine[name] - other[name]) for name in shared))
            self._status.set_value("shadow_difference", statistics.median(self._differences))
            self._status.set_value("shadow_compared", len(self._differences))


def _positions(command: JointCommand) -> Mapping[str, float]:
    return dict(zip(command.names, command.position.tolist(), strict=True))
