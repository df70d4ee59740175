"""Replay: recorded observations into a backend, without a robot, and its answers beside the
recorded ones.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rn_recorder_runs.observations import Observations, to_rows
from roboneuron import (
    F64,
    ActionChunk,
    Backend,
    RoboNeuronError,
)

if TYPE_CHECKING:
    from rn_standard.inference.agreement import SpaceAgreement

EXACT = 1e-9


@dataclass(frozen=True, slots=True)
class Compared:
    """One prediction, as recorded and as replayed.

    Attributes:
        at_ns: when it was recorded [ns].
        label: of the control space of both.
        recorded, replayed: float64 (H, n), contract units; empty where the backend refused.
        error: why the replayed backend refused; empty when it answered.
        took_s: of the replayed prediction.
    """

    at_ns: int
    label: str
    instruction: str
    recorded: F64
    replayed: F64
    error: str
    took_s: float

    @property
    def difference(self) -> F64:
        """Replayed less recorded, float64 (rows that both have, n)."""
        rows = min(len(self.recorded), len(self.replayed))
        difference: F64 = self.replayed[:rows] - self.recorded[:rows]
        return difference

    def diverges(self, tolerance: float) -> bool:
        """Whether they differ by more than that, in the number of rows, or in refusing."""
        if self.recorded.shape != self.replayed.shape:
            return True
        return bool(self.recorded.size and np.abs(self.difference).max() > tolerance)


def replay(
    observations: Observations, backend: Backend, agreement: SpaceAgreement
) -> Iterator[Compared]:
    """Ask a loaded backend everything that was asked, resetting it where the recorded one was
    reset. `agreement` makes of its answers what control would get.
    """
    size, label = agreement.executed.size, agreement.executed.label
    backend.reset()
    for prediction, observation in observations:
        facts = prediction.facts
        if facts.get("resets"):
            backend.reset()
        answer: ActionChunk | None = None
        error = ""
        begun_s = time.perf_counter()
        try:
            answer = backend.predict(observation)
        except RoboNeuronError as refusal:
            error = str(refusal)
        took_s = time.perf_counter() - begun_s
        recorded = to_rows(facts.get("rows", []), size)
        replayed = np.zeros((0, size))
        if answer is not None:
            replayed = agreement.convert(answer, observation.joints).actions
        yield Compared(
            prediction.at_ns, label, facts["instruction"], recorded, replayed, error, took_s
        )
