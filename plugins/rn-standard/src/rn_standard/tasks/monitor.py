"""What a monitor is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from roboneuron import Observation


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """What a monitor says of one observation.

    Attributes:
        value: 0 certainly not .. 1 certainly; None when it cannot be judged.
        reason: one sentence, without its full stop; never empty.
    """

    value: float | None
    reason: str


class Monitor(Protocol):
    """Judges observations of one task. Built as `target(config)`, used from one thread, loads
    nothing heavy late.

    The same observations in the same order give the same scores. What it cannot judge (a missing
    image, a hidden object, an uncalibrated camera) is a score of None, not an exception and never a
    guess.
    """

    def reset(self, observation: Observation) -> None:
        """Begin with how things are before the robot acts; called before `score`, and again before
        each attempt.
        """
        ...

    def score(self, observation: Observation) -> Score:
        """Judge one observation; at most 50 ms."""
        ...


@runtime_checkable
class RememberingMonitor(Protocol):
    """What a monitor may offer besides: to know what one of the same name and options saw in the
    task before.
    """

    def follow(self, previous: object) -> None:
        """Take over what stays true between two tasks; called before `reset`."""
        ...
