"""A run to be replayed, with its backend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rn_recorder_runs.deployed import DeployedBackend, build_backend
from rn_recorder_runs.files import read_about
from rn_recorder_runs.observations import Observations
from roboneuron import InvalidInputError

if TYPE_CHECKING:
    from roboneuron.modules.inference.agreement import SpaceAgreement


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
    """Return the run's observations, and the loaded backend for the run's robot.

    Args:
        options: options by plugin.

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
    """Raise InvalidInputError if recorded answers are of another control space than the backend's,
    so that they cannot be compared.
    """
    expected = agreement.executed.label
    if others := [label for label in observations.labels if label != expected]:
        raise InvalidInputError(
            f"The recorded answers are of the control space {', '.join(map(repr, others))}; the "
            f"backend's are of {expected!r}.",
            hint="Name the backend that was recorded, with its options.",
        )
