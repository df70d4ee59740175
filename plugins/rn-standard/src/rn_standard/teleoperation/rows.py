"""Messages between a lead and control: rows on the topic `lead`, their echo on `acting`."""

from __future__ import annotations

import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self, get_args

import numpy as np

from rn_standard.teleoperation.samples import F64
from roboneuron import InvalidInputError, UnsafeError

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray

TYPE = "std_msgs/msg/Float64MultiArray"
Mode = Literal["person", "blend", "back", "lost"]
"""Requested authority: the person alone, or the person's correction added to the policy's action;
or the end of a lead: handed back, or lost, after which motion needs a new start.
"""
RowKind = Literal["rest", "still", "twist", "joint_velocity", "joint_position"]
"""Kind of a row: `rest` lets control hold; `still` brakes within the limits to the commanded
posture.
"""
_LEAD, _GRIPPER, _ACTING, _LIMITS, _NOTE = "lead", "gripper", "acting", "limits", "note"
_MOST_RATE_HZ = 1000.0
_MOVED = 6
"""Number of values of a displacement."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class LeadRow:
    """Command of a lead for one period.

    Attributes:
        session: the lead.
        number: greater than that of the previous row.
        mode: see `Mode`.
        kind: meaning of `values`.
        keys: the frame of a twist ("base", "tool"), or names of joints.
        values: float64 (n,): twist [m/s, rad/s], velocities or positions of the joints [rad, m].
        gripper_open: 0 closed .. 1 open; None for no change.
        rate_hz: rows per second; each applies for one period.
    """

    session: str
    number: int
    mode: Mode
    kind: RowKind = "rest"
    keys: tuple[str, ...] = ()
    values: F64
    gripper_open: float | None = None
    rate_hz: float = 50.0

    def to_message(self) -> Float64MultiArray:
        """Create the std_msgs/Float64MultiArray with the labels that `from_message` reads."""
        head = f"{self.kind}@{self.rate_hz:g}:{','.join(self.keys)}"
        mark = f"{_LEAD}:{self.mode}:{self.session}:{self.number}"
        labels = [(head, len(self.values)), (mark, 0)]
        data = self.values.tolist()
        if self.gripper_open is not None:
            labels.append((_GRIPPER, 1))
            data.append(self.gripper_open)
        return _message(labels, data)

    @classmethod
    def from_message(cls, message: Float64MultiArray) -> Self:
        """Parse the row of a message.

        Raises:
            InvalidInputError: it is not a row.
            UnsafeError: a value is not finite.
        """
        dims = [(str(dim.label), int(dim.size)) for dim in message.layout.dim]
        labels = [label for label, _ in dims]
        try:
            kind, _, rest = labels[0].partition("@")
            rate, _, keys = rest.partition(":")
            lead, mode, session, number = labels[1].split(":")
            rate_hz, count = float(rate), int(number)
        except (ValueError, IndexError) as error:
            raise _no_row(labels) from error
        has_gripper = labels[2:] == [_GRIPPER]
        data = np.array(message.data, dtype=np.float64)
        is_known = kind in get_args(RowKind) and mode in get_args(Mode) and lead == _LEAD
        if (
            not is_known
            or not 0.0 < rate_hz <= _MOST_RATE_HZ
            or len(data) != dims[0][1] + has_gripper
            or (len(labels) > 2 and not has_gripper)
        ):
            raise _no_row(labels)
        if not np.isfinite(data).all():
            raise UnsafeError("A row of a lead holds a non-finite value.")
        row = cls(
            session=session,
            number=count,
            mode=mode,  # type: ignore[arg-type]
            kind=kind,  # type: ignore[arg-type]
            keys=tuple(filter(None, keys.split(","))),
            values=data[: dims[0][1]],
            gripper_open=float(data[-1]) if has_gripper else None,
            rate_hz=rate_hz,
        )
        row._check()
        return row

    def _check(self) -> None:
        """Raise InvalidInputError unless keys and values match."""
        if self.kind == "twist":
            is_right = self.keys in (("base",), ("tool",)) and len(self.values) == 6
        else:
            is_right = len(self.keys) == len(self.values) == len(set(self.keys))
        if self.gripper_open is not None and not 0.0 <= self.gripper_open <= 1.0:
            raise InvalidInputError(
                f"The gripper's opening is {self.gripper_open:g}, expected 0 .. 1."
            )
        if not is_right:
            raise InvalidInputError(
                f"A row of kind {self.kind!r} has {len(self.values)} values for {self.keys}."
            )


@dataclass(frozen=True, kw_only=True, slots=True)
class Acting:
    """Control's result for an action of the policy or a row of a lead.

    Attributes:
        who: "policy", "person", "blend" or "nobody".
        session, number: those of the newest row of a lead; empty and 0 without one.
        share: ratio of the sent to the requested step's length, 0 .. 1.
        limits: limits that acted, separated by commas.
        note: reason why the arm holds; empty if it does not.
        moved: if a person acts, the commanded displacement of the TCP after the limits: x y z [m],
            rotation vector [rad], in the base. Empty if unknown.
        gripper_open: opening commanded by the person, 0 closed .. 1 open; None for none.
    """

    who: str
    session: str = ""
    number: int = 0
    share: float = 1.0
    limits: str = ""
    note: str = ""
    moved: tuple[float, ...] = ()
    gripper_open: float | None = None

    def to_message(self) -> Float64MultiArray:
        """Create the std_msgs/Float64MultiArray with the labels that `from_message` reads."""
        moved = [self.share, *self.moved]
        if self.moved and self.gripper_open is not None:
            moved.append(self.gripper_open)
        labels = [
            (f"{_ACTING}:{self.who}", len(moved)),
            (f"{_LEAD}:{self.session}:{self.number}", 0),
            (f"{_LIMITS}:{self.limits}", 0),
            (f"{_NOTE}:{self.note}", 0),
        ]
        return _message(labels, moved)

    @classmethod
    def from_message(cls, message: Float64MultiArray) -> Self:
        """Parse the result of a message. Raises InvalidInputError for another message."""
        labels = [str(dim.label) for dim in message.layout.dim]
        try:
            who, lead, limits, note = (label.partition(":")[2] for label in labels)
            session, _, number = lead.rpartition(":")
            share, *rest = message.data
            count = int(number)
        except (ValueError, IndexError) as error:
            raise InvalidInputError(f"{labels} are not the labels of `acting`.") from error
        return cls(
            who=who,
            session=session,
            number=count,
            share=float(share),
            limits=limits,
            note=note,
            moved=tuple(map(float, rest[:_MOVED])),
            gripper_open=float(rest[_MOVED]) if len(rest) > _MOVED else None,
        )


def _message(labels: Sequence[tuple[str, int]], data: Sequence[float]) -> Float64MultiArray:
    from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout  # heavy

    dims = [MultiArrayDimension(label=label, size=size, stride=size) for label, size in labels]
    return Float64MultiArray(layout=MultiArrayLayout(dim=dims), data=array.array("d", data))


def _no_row(labels: Sequence[str]) -> InvalidInputError:
    return InvalidInputError(
        f"A message on `lead` has the labels {labels}; expected '<kind>@<rate>:<keys>' and "
        "'lead:<mode>:<session>:<number>'."
    )
