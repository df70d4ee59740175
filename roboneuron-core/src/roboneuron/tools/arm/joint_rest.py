"""Measured joints: where they are, and whether they rest."""

from __future__ import annotations

from collections.abc import Iterable

from roboneuron.contract import JointKinds, JointSample
from roboneuron.errors import NotReadyError

_REST, _REST_S = 5e-4, 0.1
"""A joint that moves by less than this [rad or m] in this time is at rest."""


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
        self._since_s: float | None = None
        self._there: list[float] = []

    def note(self, joints: JointSample, now_s: float) -> bool:
        """Add a measurement; return True if no joint has moved for a tenth of a second."""
        here = [position_of(joints, name) for name in self._names]
        has_moved = (
            not self._there
            or max(map(abs, map(self._kinds.difference, self._names, self._there, here))) > _REST
        )
        if self._since_s is None or has_moved:
            self._since_s, self._there = now_s, here
            return False
        return now_s - self._since_s >= _REST_S
