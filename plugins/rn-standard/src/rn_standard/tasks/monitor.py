"""Protocol of monitors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from roboneuron import Observation


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """Result of a monitor for one observation.

    Attributes:
        value: 0 certainly not .. 1 certainly; None if it cannot be decided. Of a monitor that
            watches a task: the probability that the instruction is carried out.
        reason: one sentence, without its full stop; never empty.
        progress: share of the task that is done, 0 .. 1; None if not estimated.
        failure: probability that this attempt has failed (dropped, wrong object, empty hand), 0 ..
            1; None if not estimated.
    """

    value: float | None
    reason: str
    progress: float | None = None
    failure: float | None = None


class Monitor(Protocol):
    """Evaluates observations of one task. Built as `target(config)`, used from one thread, loads
    nothing heavy late.

    The same observations in the same order give the same scores. If it cannot decide (a missing
    image, a hidden object, an uncalibrated camera), the score is None, not an exception and never a
    guess.
    """

    def reset(self, observation: Observation) -> None:
        """Store the initial state, before the robot acts; called before `score`, and again before
        each attempt.
        """
        ...

    def score(self, observation: Observation) -> Score:
        """Score one observation, within `limit_s` of its descriptor.

        The observation has the instruction, the newest image of each camera with its time, and the
        measured TCP pose and opening.
        """
        ...


@runtime_checkable
class RememberingMonitor(Protocol):
    """Optional interface of a monitor: access to the monitor of the same name and options in the
    previous task.
    """

    def follow(self, previous: object) -> None:
        """Copy the state that stays valid between two tasks; called before `reset`."""
        ...
