"""The contract case of the native backend: a tiny random checkpoint, made for the occasion."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from pathlib import Path

from rn_backend_pi0.plugin import roboneuron_backends
from rn_testing import BackendCase

ROW_TOLERANCE = 0.01
"""Guided rows end this near to the committed ones [m, rad, opening]; here 0.002 (0.55 without)."""


def native_case() -> BackendCase:
    """The backend "pi0" with a checkpoint in a temporary directory that lasts as long as the
    process.
    """
    from rn_backend_pi0.tiny import make_tiny  # heavy

    directory = Path(tempfile.mkdtemp(prefix="roboneuron-pi0-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    make_tiny(directory)
    spec = next(spec for spec in roboneuron_backends() if spec.name == "pi0")
    options = {"checkpoint": str(directory), "device": "cpu", "cpu_threads": 1}
    return BackendCase(spec=spec, options=options, row_tolerance=ROW_TOLERANCE)
