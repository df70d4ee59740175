"""The source that moved the arm in each row of a run, and a person's actions, from control's topic
`acting`.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from roboneuron import EE_DELTA, matrix_from_rotvec, rotvec_from_matrix

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray

F64 = NDArray[np.float64]

POLICY, PERSON, BLEND, NOBODY = WHO = ("policy", "person", "blend", "nobody")
"""Sources that move the arm; the first if nothing else was reported."""
LED = (PERSON, BLEND)
_WORD = "acting"
_MOVED = 6
_TOLD_NS = 250_000_000
"""Time after which a report of control belongs to another action."""


@dataclass(frozen=True, slots=True)
class ActedRow:
    """Control's result for an action of the policy or a row of a person.

    Attributes:
        at_ns: time of the report [ns].
        who: one of `WHO`.
        moved: float64 (6,), displacement of the TCP in the base that a person's row commanded: x y
            z [m], rotation vector [rad]; (0,) if not reported.
        gripper_open: commanded by the person, 0 closed .. 1 open; None for none.
    """

    at_ns: int
    who: str
    moved: F64
    gripper_open: float | None = None

    @classmethod
    def from_message(cls, message: Float64MultiArray, at_ns: int) -> ActedRow:
        """Read a message of the topic; see `rn_standard.teleoperation.rows.Acting`."""
        dims = message.layout.dim
        word, _, who = (dims[0].label if dims else "").partition(":")
        if word != _WORD or who not in WHO:
            return cls(at_ns, POLICY, np.zeros(0))
        values = np.array(message.data[1:], dtype=np.float64)
        gripper = float(values[_MOVED]) if len(values) > _MOVED else None
        return cls(at_ns, who, values[:_MOVED], gripper)


@dataclass(frozen=True, slots=True)
class Deed:
    """Executed action during one action of the policy.

    Attributes:
        who: one of `WHO`.
        action: float64 (n,) as executed, in the policy's space; (0,) if a person acted and it
            cannot be expressed in that space.
    """

    who: str
    action: F64


class Deeds:
    """Iterates over the actions of a run in their order.

    Args:
        acted: in order of time.
    """

    def __init__(self, acted: Sequence[ActedRow]) -> None:
        self._acted = acted
        self._times = [row.at_ns for row in acted]
        self._opening: float | None = None

    def next(self, action: F64, label: str, sent_ns: int, until_ns: int) -> Deed:
        """Executed action from this action of the policy until the next one.

        Args:
            action: float64 (n,), of the policy.
            label: label of its control space.
            sent_ns: time of sending [ns].
            until_ns: time of sending of the next one [ns].
        """
        first = bisect_right(self._times, sent_ns)
        # control reports after executing the action, or a row of a person meanwhile
        is_told = first < len(self._acted) and self._times[first] - sent_ns < _TOLD_NS
        who = self._acted[first].who if is_told else POLICY
        is_delta = label == EE_DELTA.label
        if who == POLICY:
            self._opening = float(action[-1]) if is_delta else None
            return Deed(who, action)
        if not is_delta:
            return Deed(who, np.zeros(0))
        rows = self._acted[first : bisect_right(self._times, until_ns)]
        asked = [row.gripper_open for row in rows if row.gripper_open is not None]
        if asked:
            self._opening = asked[-1]
        elif who == BLEND or self._opening is None:
            self._opening = float(action[-1])
        moved = composed([row.moved for row in rows if row.who in LED])
        return Deed(who, np.append(moved, self._opening) if len(moved) else moved)


def composed(displacements: Sequence[F64]) -> F64:
    """Compose consecutive displacements to one, float64 (6,); (0,) if one of them is unknown.

    Of none: zeros.
    """
    if any(len(one) != _MOVED for one in displacements):
        return np.zeros(0)
    place, turn = np.zeros(3), np.eye(3)
    for one in displacements:
        place = place + one[:3]
        turn = matrix_from_rotvec(one[3:]) @ turn
    return np.concatenate([place, rotvec_from_matrix(turn)])
