"""The contract cases of the native backends: tiny random checkpoints, created at run time."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from pathlib import Path

from rn_backend_pi0.architecture import Variant
from rn_backend_pi0.plugin import roboneuron_backends
from rn_testing import BackendCase

ROW_TOLERANCE = 0.01
"""Largest distance of guided rows from the committed ones [m, rad, opening]; measured 0.002 (0.55
without guidance).
"""


def native_case() -> BackendCase:
    """The backend "pi0" with a checkpoint in a temporary directory that is removed when the process
    exits.
    """
    return _case("pi0", "pi0", {}, row_tolerance=ROW_TOLERANCE)


def fast_case() -> BackendCase:
    """The backend "pi0-fast" likewise. All tokens are admitted, because a random model mostly
    prefers ones that are no action tokens.
    """
    return _case("pi0-fast", "pi0_fast", {"max_outside_share": 1.0, "fast_length": "padded"})


def _case(
    name: str, variant: Variant, more: dict[str, object], row_tolerance: float | None = None
) -> BackendCase:
    from rn_backend_pi0.tiny import make_tiny  # heavy

    directory = Path(tempfile.mkdtemp(prefix="roboneuron-pi0-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    make_tiny(directory, variant=variant)
    spec = next(spec for spec in roboneuron_backends() if spec.name == name)
    options = {"checkpoint": str(directory), "device": "cpu", "cpu_threads": 1, **more}
    return BackendCase(spec=spec, options=options, row_tolerance=row_tolerance)
