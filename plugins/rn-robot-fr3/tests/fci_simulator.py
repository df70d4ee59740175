"""Helpers for tests against franka-sim."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rn_robot_fr3.fci.driver import FciDriver
from roboneuron.plugins.availability import is_importable

PYTHON = Path(
    os.environ.get(
        "ROBONEURON_FR3SIM_PYTHON", Path(__file__).parents[3] / ".venv-fr3sim/bin/python"
    )
)
MARKS = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not PYTHON.exists(), reason="franka-sim is not installed: make .venv-fr3sim"
    ),
    pytest.mark.skipif(
        not is_importable("pylibfranka"),
        reason="needs pylibfranka: pip install './plugins/rn-robot-fr3[fci]'",
    ),
]
_PATIENCE_S = 30.0


def until(driver: FciDriver, check: Callable[[], bool]) -> None:
    """Read like the robot module until the condition holds, because a driver that is not read stops
    the arm.
    """
    deadline_s = time.monotonic() + _PATIENCE_S
    while not check():
        state = driver.read()
        assert time.monotonic() < deadline_s, state.detail
        time.sleep(0.01)
