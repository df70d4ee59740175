"""The contract cases of the native backends: tiny random checkpoints, made for the occasion."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from pathlib import Path

from rn_backend_pi0.architecture import Variant
from rn_backend_pi0.plugin import roboneuron_backends
from rn_testing import BackendCase

ROW_TOLERANCE = 0.01
"""Guided rows end this near to the committed ones [m, rad, opening]; here 0.002 (0.55 without)."""


def native_case() -> BackendCase:
    """The backend "pi0" with a checkpoint in a temporary directory that lasts as long as the
    process.
    """
    return _case("pi0", "pi0", {}, row_tolerance=ROW_TOLERANCE)


def fast_case() -> BackendCase:
    """The backend "pi0-fast" likewise; a random model would mostly write something else than
    actions.
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
