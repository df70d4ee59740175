"""The weights shipped with this package."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from roboneuron import ConfigurationError

WEIGHTS_FILE = "cubes-policy.safetensors"
FLOW_FILE = "cubes-flow-policy.safetensors"


def shipped_weights() -> Path:
    """Path of the shipped packed file. Raises ConfigurationError if this build has none."""
    path = Path(str(files("rn_policy_cubes") / "data" / WEIGHTS_FILE))
    if not path.exists():
        raise ConfigurationError(
            "This build of rn-policy-cubes has no weights.",
            hint="Train them: make train-cubes; then: roboneuron policy cubes pack --to FILE",
        )
    return path


def shipped_flow_weights() -> Path:
    """Path of the shipped packed file of the flow policy. Raises ConfigurationError if this build
    has none.
    """
    path = Path(str(files("rn_policy_cubes") / "data" / FLOW_FILE))
    if not path.exists():
        raise ConfigurationError(
            "This build of rn-policy-cubes has no weights of the flow policy.",
            hint="Train them: roboneuron policy cubes flow train; then: policy cubes flow pack "
            "--to FILE",
        )
    return path
