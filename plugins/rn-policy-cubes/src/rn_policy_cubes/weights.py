"""The weights shipped with this package."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from roboneuron import ConfigurationError

WEIGHTS_FILE = "cubes-policy.safetensors"


def shipped_weights() -> Path:
    """Path of the shipped packed file. Raises ConfigurationError if this build has none."""
    path = Path(str(files("rn_policy_cubes") / "data" / WEIGHTS_FILE))
    if not path.exists():
        raise ConfigurationError(
            "This build of rn-policy-cubes has no weights.",
            hint="Train them: make train-cubes; then: roboneuron cubes-policy pack --to FILE",
        )
    return path
