"""Why a robot does not move: the reasons of the mechanisms that forbid motion, in one order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from roboneuron.errors import RefusedError

StillRank: TypeAlias = Literal[
    "service",
    "stop",
    "server",
    "module",
    "hold",
    "start",
    "claim",
    "operator",
    "role",
    "person",
]
"""Kinds of reasons, in the order in which to remove them; see docs/safety-reference.md.

Up to "start" they keep the robot still whoever asks: a person has taken it out of service (until
then no stop can be released), the emergency stop is latched, the server may not send, a module that
the motion needs does not work, control holds the arm against what moves it, there was a stop. The
later ones keep one client from moving it: something else moves it, another client operates it, the
client's role is too low, a person has to agree.
"""
RANKS: tuple[StillRank, ...] = get_args(StillRank)


@dataclass(frozen=True, kw_only=True, slots=True)
class StillReason:
    """Why the robot does not move, by one mechanism.

    Attributes:
        rank: its place in the answer.
        rule: stable word, the same as in refusals of that mechanism.
        message: a sentence of what is so.
        hint: what to do next, one sentence; empty if the message already says it.
    """

    rank: StillRank
    rule: str
    message: str
    hint: str = ""

    @property
    def is_for_everyone(self) -> bool:
        """True if the robot keeps still whoever asks; False if it may move for another client."""
        return RANKS.index(self.rank) <= RANKS.index("start")

    def __str__(self) -> str:
        return f"{self.message} {self.hint}".rstrip()

    def refusal(self, note: str = "") -> RefusedError:
        """The refusal of a call for this reason; `note` follows the message."""
        return RefusedError(f"{self.message}{note}", hint=self.hint, rule=self.rule)


def in_order(reasons: Iterable[StillReason | None]) -> tuple[StillReason, ...]:
    """Sort reasons by rank, and as given within a rank; None is left out."""
    return tuple(sorted(filter(None, reasons), key=lambda reason: RANKS.index(reason.rank)))
