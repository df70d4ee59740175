"""The monitor's weights: one small safetensors file with its recipe and thresholds."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from safetensors import safe_open
from safetensors.numpy import save_file

from rn_policy_cubes.monitor.layers import MonitorLayers
from roboneuron import ConfigurationError

MONITOR_FILE = "cubes-monitor.safetensors"
_CARD = "card"


class MonitorCard(BaseModel):
    """Description of the weights.

    Attributes:
        recipe: of the training, by field.
        step: optimiser steps done.
        episodes: episodes of the training by kind.
        success_threshold: lowest probability over the time of holding that counts as success.
        failure_threshold: the same for a failed attempt.
        calibrated_on: episodes of the calibration by kind; empty before it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    recipe: dict[str, float]
    step: int
    episodes: dict[str, int]
    success_threshold: float = Field(default=0.5, gt=0, lt=1)
    failure_threshold: float = Field(default=0.5, gt=0, lt=1)
    calibrated_on: dict[str, int] = {}


@dataclass(frozen=True, slots=True, eq=False)
class MonitorWeights:
    """The content of a file of weights."""

    card: MonitorCard
    layers: MonitorLayers

    @classmethod
    def read(cls, path: Path) -> MonitorWeights:
        """Read a file written by `write`. Raises OSError or ValueError for another one."""
        with safe_open(path, framework="numpy") as file:
            card = MonitorCard.model_validate_json(file.metadata()[_CARD])
            tensors = {
                name: file.get_tensor(name).astype(np.float32)
                for name in file.keys()  # noqa: SIM118 - no mapping
            }
        return cls(card, MonitorLayers(tensors))

    def write(self, path: Path) -> None:
        """Write the file, in half precision."""
        tensors = {name: value.astype(np.float16) for name, value in self.layers.tensors.items()}
        save_file(tensors, path, metadata={_CARD: self.card.model_dump_json()})


def shipped_monitor() -> Path:
    """Path of the shipped weights. Raises ConfigurationError if this build has none."""
    path = Path(str(files("rn_policy_cubes") / "data" / MONITOR_FILE))
    if not path.exists():
        raise ConfigurationError(
            "This build of rn-policy-cubes has no weights of the monitor.",
            hint="Train them: roboneuron policy cubes monitor train",
        )
    return path
