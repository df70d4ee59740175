"""The way of an arm that a planner has chosen, judged by what is measured while it goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from rn_standard.direct_path.message_types import RosMessage
from rn_standard.direct_path.path_limits import Leg, LimitError, PathLimiter, check_zones
from rn_standard.direct_path.plans import is_plan_only, plans_in
from rn_standard.direct_path.request import AllowedEndpoint
from roboneuron import F64, JointSample, Obstacle, RefusedError

_PERIOD_S = 0.05
"""How often the way is looked at."""
_SILENCE_S = 1.0
"""Without a measurement for so long a way that somebody else has planned ends."""
_TREMBLE = 1e-3
"""Change of a joint [rad or m] that is no motion; an arm that rests in a zone has not come into it.
"""


def watch_of(
    allowed: AllowedEndpoint,
    messages: Sequence[RosMessage],
    joints: Callable[[], JointSample | None],
) -> WayWatch | None:
    """The watch over what a planner is asked to carry out; None where no arm is to be moved.

    Args:
        allowed: the endpoint, with the limits of its arm.
        messages: were allowed.
        joints: the newest measured joints.
    """
    is_moving = any(plans_in(message) and not is_plan_only(message) for message in messages)
    if allowed.path is None or not is_moving:
        return None
    return WayWatch(allowed.path(), allowed.endpoint.zones, joints)


class WayWatch:
    """Watches an arm on a way that somebody else has planned, by its measured joints.

    Args:
        limiter: judges the way from one measurement to the next.
        zones: boxes beside its own that no TCP may come into.
        joints: the newest measured joints; None when there are no recent ones.
        now_s: monotonic time [s].
    """

    def __init__(
        self,
        limiter: PathLimiter,
        zones: Sequence[Obstacle],
        joints: Callable[[], JointSample | None],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._limiter, self._zones, self._joints, self._now_s = limiter, zones, joints, now_s
        self._last: JointSample | None = None
        self._due_s = 0.0
        self._seen_s = now_s()

    def check(self) -> None:
        """Raise RefusedError once the arm is where it may not be, or is not measured any more."""
        now_s = self._now_s()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _PERIOD_S
        joints = self._joints()
        if joints is None:
            if now_s - self._seen_s > _SILENCE_S:
                raise RefusedError("The joints are not measured any more.", rule="kinematics")
            return
        self._seen_s = now_s
        before = self._last
        if before is None:
            self._last = joints
        elif before.names != joints.names or _has_moved(before.position, joints.position):
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


def _has_moved(before: F64, now: F64) -> bool:
    """Whether joints have moved more than measurements tremble."""
    return bool((np.abs(now - before) > _TREMBLE).any())


def _is_in(zone: Obstacle, place_m: F64) -> bool:
    return bool((zone.lower_m <= place_m).all() and (place_m <= zone.upper_m).all())
