"""Kinds of joints of a robot description: what their positions mean, and how far two are apart."""

from __future__ import annotations

import functools
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.errors import ConfigurationError

TURN = 2.0 * math.pi
_MOVING = ("revolute", "continuous", "prismatic")
_ROUNDING = 1e-9
"""Tolerance for a position that a whole number of turns brings to a limit [rad]."""


@functools.lru_cache(maxsize=16)
def urdf_joints(urdf: str) -> tuple[ET.Element, ...]:
    """The joints of a URDF, not to be modified; empty for an invalid URDF."""
    try:
        return tuple(ET.fromstring(urdf).findall("joint"))
    except ET.ParseError:
        return ()


@dataclass(frozen=True, kw_only=True, slots=True)
class MimicJoint:
    """A joint that follows another one: position = multiplier * leader + offset.

    Attributes:
        name: of the joint.
        leader: a joint that follows none itself.
        multiplier, offset: [rad or m per rad or m], [rad or m]; of a follower of a follower, those
            of the whole chain.
    """

    name: str
    leader: str
    multiplier: float
    offset: float


def nearest_turn(start: float, goal: float, lower: float, upper: float) -> float:
    """`JointKinds.nearest` for a continuous joint [rad]."""
    if not math.isfinite(goal - start):
        return goal
    turns = float(round((start - goal) / TURN))
    least, most = (lower - _ROUNDING - goal) / TURN, (upper + _ROUNDING - goal) / TURN
    least = math.ceil(least) if math.isfinite(least) else least
    most = math.floor(most) if math.isfinite(most) else most
    return goal if least > most else goal + TURN * min(max(turns, least), most)


class JointKinds:
    """The kinds of the joints of one robot description. Get it from `of`.

    A position of a continuous joint and the same with whole turns added are one posture. A robot
    may count turns or not; all that compares measured positions uses `difference`, and all that
    sends a joint to a position uses `nearest`, so that both mean the same.

    Attributes:
        moving: names of the revolute, continuous and prismatic joints, in the description's order.
        prismatic: names of the joints whose positions are in metres.
        continuous: names of the joints that turn without end.
    """

    def __init__(self, urdf: str) -> None:
        """Args:
        urdf: the description; an invalid one has no joints.
        """
        self._joints = {j.get("name", ""): j for j in urdf_joints(urdf)}
        kinds = {name: joint.get("type", "") for name, joint in self._joints.items()}
        self.moving = tuple(name for name, kind in kinds.items() if kind in _MOVING)
        self.prismatic = frozenset(n for n, kind in kinds.items() if kind == "prismatic")
        self.continuous = frozenset(n for n, kind in kinds.items() if kind == "continuous")

    @classmethod
    @functools.lru_cache(maxsize=16)
    def of(cls, urdf: str) -> JointKinds:
        """Those of a description, read once."""
        return cls(urdf)

    @functools.cached_property
    def followers(self) -> tuple[MimicJoint, ...]:
        """The joints that follow another one.

        Raises:
            ConfigurationError: a joint follows itself, none that moves, or by no number.
        """
        return tuple(self._follower(n) for n in self.moving if self._mimic(n) is not None)

    def difference(self, joint: str, start: float, end: float) -> float:
        """`end` - `start` [rad or m]: for a continuous joint the shorter way, at most half a
        turn.
        """
        change = end - start
        if joint in self.continuous and math.isfinite(change):
            return math.remainder(change, TURN)
        return change

    def nearest(
        self,
        joint: str,
        start: float,
        goal: float,
        lower: float = -math.inf,
        upper: float = math.inf,
    ) -> float:
        """`goal` as a joint at `start` reaches it soonest [rad or m].

        For a continuous joint whole turns are added, as far as the limits allow; for others it is
        `goal`. A range of less than one turn holds one such position, so that there a continuous
        joint moves as a revolute one does. `goal` itself if the limits contain none.
        """
        return nearest_turn(start, goal, lower, upper) if joint in self.continuous else goal

    def span(self, names: Sequence[str]) -> JointSpan:
        """`difference` and `nearest` for arrays of these joints."""
        return JointSpan(self, names)

    def configuration(self, order: Sequence[str] | None = None) -> JointConfiguration:
        """The conversion of named positions to a vector in this order, `moving` without one.
        Raises ConfigurationError as `followers`.
        """
        return JointConfiguration(self, self.moving if order is None else tuple(order))

    def rest(self, joint: str) -> float:
        """Position of a joint that is not measured: 0, or the limit nearest to it [rad or m]."""
        lower, upper = self.limits(joint)
        return min(max(0.0, lower), upper)

    def farthest(self, joint: str) -> float:
        """Largest distance of a prismatic joint from its zero [m]; 1 m without limits."""
        ends = map(abs, self.limits(joint))
        return max(end if math.isfinite(end) else 1.0 for end in ends)

    def limits(self, joint: str) -> tuple[float, float]:
        """Position limits of the description [rad or m]; infinite where it has none, and for a
        continuous joint.
        """
        if joint in self.continuous:
            return -math.inf, math.inf
        return self._limit(joint, "lower"), self._limit(joint, "upper")

    def velocity_limit(self, joint: str) -> float:
        """Velocity limit of the description [rad/s or m/s]; infinite where it has none."""
        return self._limit(joint, "velocity")

    def _limit(self, joint: str, side: str) -> float:
        default = -math.inf if side == "lower" else math.inf
        limit = self._joints[joint].find("limit")
        return _number(joint, "limit", side, None if limit is None else limit.get(side), default)

    def _mimic(self, joint: str) -> ET.Element | None:
        return self._joints[joint].find("mimic")

    def _follower(self, joint: str) -> MimicJoint:
        leader, multiplier, offset = joint, 1.0, 0.0
        for _ in self.moving:
            mimic = self._mimic(leader)
            if mimic is None:
                return MimicJoint(name=joint, leader=leader, multiplier=multiplier, offset=offset)
            offset += multiplier * _number(leader, "mimic", "offset", mimic.get("offset"), 0.0)
            multiplier *= _number(leader, "mimic", "multiplier", mimic.get("multiplier"), 1.0)
            leader = mimic.get("joint", "")
            if leader not in self.moving:
                raise ConfigurationError(
                    f"URDF joint {joint!r} mimics {leader!r}, which is no joint that moves.",
                    hint="Name a revolute, continuous or prismatic joint, or make it fixed.",
                )
        raise ConfigurationError(
            f"URDF joint {joint!r} mimics itself.", hint="Let one of these joints lead."
        )


class JointSpan:
    """`JointKinds.difference` and `nearest` for n named joints; arrays are float64 (n,).

    Attributes:
        is_turning: one of the joints is continuous.
    """

    def __init__(self, kinds: JointKinds, names: Sequence[str]) -> None:
        self._kinds = kinds
        self._turning = [(i, name) for i, name in enumerate(names) if name in kinds.continuous]
        self.is_turning = bool(self._turning)

    def difference(self, start: F64, end: F64) -> F64:
        """`end` - `start`; for continuous joints the shorter way."""
        change: F64 = end - start
        for i, name in self._turning:
            change[i] = self._kinds.difference(name, float(start[i]), float(end[i]))
        return change

    def nearest(
        self, start: F64, goal: F64, lower: F64 | None = None, upper: F64 | None = None
    ) -> F64:
        """`goal` as joints at `start` reach it soonest; itself without continuous joints."""
        if not self._turning:
            return goal
        near: F64 = goal.copy()
        for i, name in self._turning:
            low = -math.inf if lower is None else float(lower[i])
            high = math.inf if upper is None else float(upper[i])
            near[i] = self._kinds.nearest(name, float(start[i]), float(goal[i]), low, high)
        return near


class JointConfiguration:
    """Positions of a robot's joints as one vector; used from one thread.

    A follower is where its leader puts it, whether it is measured or not, unless the leader is not
    known. A joint without a position is at rest: at 0, or at the limit nearest to it.

    Attributes:
        order: names of the joints, in the order of the vector.
    """

    def __init__(self, kinds: JointKinds, order: tuple[str, ...]) -> None:
        self.order = order
        self._followers = kinds.followers
        leaders = [f.leader for f in self._followers if f.leader not in order]
        # a leader outside of the order is kept behind it
        self._places = {name: i for i, name in enumerate(dict.fromkeys((*order, *leaders)))}
        self._rest = np.array([kinds.rest(name) for name in self._places])
        self._names: tuple[str, ...] | None = None
        self._source, self._target, self._rows, self._leaders = ([0] for _ in range(4))
        self._multiplier = self._offset = np.zeros(0)

    def __call__(self, names: tuple[str, ...], position: F64) -> F64:
        """The vector float64 (m,) for positions (n,) of named joints; unknown ones are left out."""
        if names != self._names:
            self._read(names)
        full = self._rest.copy()
        full[self._target] = position[self._source]
        if self._rows:
            full[self._rows] = self._multiplier * full[self._leaders] + self._offset
        return full if len(full) == len(self.order) else full[: len(self.order)]

    def of(self, joints: Mapping[str, float]) -> F64:
        """The vector for positions by name."""
        return self(tuple(joints), np.array(list(joints.values()), dtype=np.float64))

    def _read(self, names: tuple[str, ...]) -> None:
        known = [(i, self._places[name]) for i, name in enumerate(names) if name in self._places]
        self._source, self._target = [i for i, _ in known], [place for _, place in known]
        led = [
            f
            for f in self._followers
            if f.name in self._places and (f.leader in names or f.name not in names)
        ]
        self._rows = [self._places[f.name] for f in led]
        self._leaders = [self._places[f.leader] for f in led]
        self._multiplier = np.array([f.multiplier for f in led])
        self._offset = np.array([f.offset for f in led])
        self._names = names


def _number(joint: str, element: str, key: str, text: str | None, default: float) -> float:
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise ConfigurationError(
            f"URDF joint {joint!r}: {key} of its {element} is {text!r}, expected a number."
        )
    return value
