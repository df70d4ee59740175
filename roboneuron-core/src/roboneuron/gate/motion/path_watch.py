"""Checks of an arm on a path chosen by a planner, by measurements during the motion."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from roboneuron.contract import JointKinds, JointSample, Obstacle
from roboneuron.contract.arrays import F64
from roboneuron.errors import RefusedError
from roboneuron.gate.motion.path_limits import Leg, LimitError, PathLimiter, check_zones

_PERIOD_S = 0.05
"""Period of the checks."""
SILENCE_S = 1.0
"""Time without a recent measurement after which a motion is ended, because a server on a busy
machine takes states late.
"""
_TREMBLE = 1e-3
"""Change of a joint [rad or m] below which it is at rest; an arm at rest in a zone has not entered
it.
"""


class WayWatch:
    """Watches an arm on an externally planned path, by its measured joints.

    Args:
        limiter: checks the path between two measurements.
        zones: additional boxes that no TCP may enter.
        joints: returns the newest measured joints; None without recent ones.
        kinds: of the joints of the robot.
        now_s: monotonic time [s].
    """

    def __init__(
        self,
        limiter: PathLimiter,
        zones: Sequence[Obstacle],
        joints: Callable[[], JointSample | None],
        kinds: JointKinds,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._limiter, self._zones, self._joints, self._now_s = limiter, zones, joints, now_s
        self._kinds = kinds
        self._last: JointSample | None = None
        self._due_s = 0.0
        self._seen_s = now_s()

    def check(self) -> None:
        """Raise RefusedError if the arm is in a forbidden posture, or is no longer measured."""
        now_s = self._now_s()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _PERIOD_S
        joints = self._joints()
        if joints is None:
            if now_s - self._seen_s > SILENCE_S:
                raise RefusedError("The joints are not measured any more.", rule="kinematics")
            return
        self._seen_s = now_s
        before = self._last
        if before is None:
            self._last = joints
            return
        # in the turns of the measurement before, so that the path between them is the short one
        position = self._kinds.span(joints.names).nearest(_at(before, joints), joints.position)
        joints = replace(joints, position=position)
        if before.names != joints.names or _has_moved(before.position, joints.position):
            self._last = joints
            self._judge(before, joints)

    def _judge(self, before: JointSample, joints: JointSample) -> None:
        finite = np.isfinite(joints.position)
        names = tuple(name for name, is_known in zip(joints.names, finite, strict=True) if is_known)
        leg = Leg(names=names, position=joints.position[finite], duration_s=None)
        try:
            self._limiter.check([leg], before)
            if not self._zones:
                return
            tips = (self._limiter.posture(before).arms, self._limiter.posture(joints).arms)
            for start, end in zip(*tips, strict=True):
                left = [zone for zone in self._zones if _is_in(zone, start.pose.position_m)]
                place, others = end.pose.position_m, [z for z in self._zones if z not in left]
                check_zones(place, place, others, "")
        except LimitError as error:
            raise RefusedError(
                f"The arm has left its limits. {error.message}", rule="path"
            ) from error


def _at(before: JointSample, joints: JointSample) -> F64:
    """Positions before, in the order of `joints`; as in `joints` for those that were not known."""
    known = dict(zip(before.names, before.position.tolist(), strict=True))
    values = zip(joints.names, joints.position.tolist(), strict=True)
    return np.array([known.get(name, value) for name, value in values])


def _has_moved(before: F64, now: F64) -> bool:
    """True if joints have moved more than the measurement noise."""
    return bool((np.abs(now - before) > _TREMBLE).any())


def _is_in(zone: Obstacle, place_m: F64) -> bool:
    return bool((zone.lower_m <= place_m).all() and (place_m <= zone.upper_m).all())
