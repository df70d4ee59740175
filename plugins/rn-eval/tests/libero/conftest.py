"""The golden arrays, and a simulator process without a simulator."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def golden():
    with np.load(HERE / "golden" / "libero.npz") as arrays:
        return {name: arrays[name] for name in arrays.files}


@pytest.fixture
def stand_in(tmp_path):
    """An "interpreter" that answers like the simulator, without one: a task is done after several
    closing actions.
    """
    script = tmp_path / "python"
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{HERE / "stand_in.py"}"\n')
    script.chmod(0o755)
    return script
