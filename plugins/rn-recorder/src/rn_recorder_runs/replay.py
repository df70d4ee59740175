"""Replay: recorded observations into a backend, without a robot, and its answers beside the
recorded ones.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rn_recorder_runs.deployed import DeployedBackend, build_backend
from rn_recorder_runs.files import read_about
from rn_recorder_runs.observations import Observations, to_rows
from roboneuron import (
    F64,
    ActionChunk,
    Backend,
    InvalidInputError,
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


def load_replayed(
    files: Sequence[Path],
    *,
    backend: str,
    config: Path | None,
    checkpoint: str | None,
    runtime: str | None,
    acceleration: str | None,
    options: Mapping[str, Mapping[str, object]],
) -> tuple[Observations, DeployedBackend]:
    """The run's observations, and the backend, loaded, for the robot that the run is of.

    Args:
        options: by name of the plugin that takes them.

    Raises:
        InvalidInputError: the run's answers are of another control space than the backend's.
        RoboNeuronError: the backend does not fit the robot, or cannot be loaded; or as
            `build_backend` and `Observations`.
    """
    from roboneuron.command import load_config

    about = read_about(files[0])
    settings = load_config(config)
    deployed = build_backend(
        settings,
        backend=backend,
        robot=about.get("robot", settings.robot.name),
        driver=about.get("driver", settings.robot.driver),
        checkpoint=checkpoint,
        runtime=runtime,
        acceleration=acceleration,
        options=options,
    )
    observations = Observations(
        files, deployed.cameras, frozenset(deployed.spec.optional_cameras), deployed.profile
    )
    check_labels(observations, deployed.agreement)
    deployed.backend.load()
    return observations, deployed


def check_labels(observations: Observations, agreement: SpaceAgreement) -> None:
    """Raises InvalidInputError when recorded answers are of another control space than those of
    the backend, so that nothing can be compared.
    """
    expected = agreement.executed.label
    if others := [label for label in observations.labels if label != expected]:
        raise InvalidInputError(
            f"The recorded answers are of the control space {', '.join(map(repr, others))}; the "
            f"backend's are of {expected!r}.",
            hint="Name the backend that was recorded, with its options.",
        )
