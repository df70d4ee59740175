"""Measured joints: where they are, and whether they rest."""

from __future__ import annotations

from collections.abc import Iterable

from roboneuron.contract import JointKinds, JointSample
from roboneuron.errors import NotReadyError

_REST, _REST_NS = 5e-4, 100_000_000
"""A joint that moves by less than this [rad or m] in this time is at rest."""


def measured_ns(joints: JointSample, now_s: float) -> int:
    """Time of a measurement [ns]: now for one without a stamp.

    Rest is judged by these times and not by those of reading, because a busy robot may send nothing
    for a while although it moves.

    Args:
        joints: the measurement.
        now_s: monotonic time.
    """
    return joints.stamp_ns or round(now_s * 1e9)


def position_of(joints: JointSample, name: str) -> float:
    """Position of a joint [rad or m]. Raises NotReadyError if it is not measured."""
    position = joints.get(name)
    if position is None:
        raise NotReadyError(f"Joint {name!r} is not measured.", hint="See get_status.")
    return position


class JointRest:
    """Detects from successive measurements that joints are at rest."""

    def __init__(self, names: Iterable[str], kinds: JointKinds) -> None:
        """`names` are of the joints, `kinds` those of the robot."""
        self._names = tuple(names)
        self._kinds = kinds
        self._since_ns: int | None = None
        self._there: list[float] = []

    def note(self, joints: JointSample, now_s: float) -> bool:
        """Add a measurement, also one that was added before; return True if no joint has moved for
        a tenth of a second between the times of measurements.
        """
        at_ns = measured_ns(joints, now_s)
        here = [position_of(joints, name) for name in self._names]
        has_moved = (
            not self._there
            or max(map(abs, map(self._kinds.difference, self._names, self._there, here))) > _REST
        )
        if self._since_ns is None or has_moved:
            self._since_ns, self._there = at_ns, here
            return False
        return at_ns - self._since_ns >= _REST_NS
