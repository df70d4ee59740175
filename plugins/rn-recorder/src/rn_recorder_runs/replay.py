"""Replay of recorded observations with a backend, without a robot, and comparison with the recorded
answers.
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
    from roboneuron.modules.inference.agreement import SpaceAgreement

EXACT = 1e-9


@dataclass(frozen=True, slots=True)
class Compared:
    """One prediction, recorded and replayed.

    Attributes:
        at_ns: time of the recording [ns].
        label: label of the control space of both.
        recorded, replayed: float64 (H, n), contract units; empty if the backend refused.
        error: reason of the replayed backend's refusal; empty if it answered.
        took_s: duration of the replayed prediction.
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
        """Replayed minus recorded, float64 (common rows, n)."""
        rows = min(len(self.recorded), len(self.replayed))
        difference: F64 = self.replayed[:rows] - self.recorded[:rows]
        return difference

    def diverges(self, tolerance: float) -> bool:
        """True if they differ by more than the tolerance, in the number of rows, or in refusing."""
        if self.recorded.shape != self.replayed.shape:
            return True
        return bool(self.recorded.size and np.abs(self.difference).max() > tolerance)


def replay(
    observations: Observations, backend: Backend, agreement: SpaceAgreement
) -> Iterator[Compared]:
    """Run a loaded backend on all recorded inputs, reset as in the recording. `agreement` converts
    its answers as for control.
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
