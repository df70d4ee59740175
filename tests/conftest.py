"""Fixtures for tests that cross packages: every test runs on a ROS graph and with a state directory
of its own.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from rn_testing.domain import free_ros_domain

ROOT = Path(__file__).parents[1]


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Environment for child processes: own ROS domain, own state, the interpreter's scripts first
    on PATH.
    """
    scripts = str(Path(sys.executable).parent)
    return {
        **{key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")},
        "ROS_DOMAIN_ID": str(free_ros_domain()),
        "XDG_STATE_HOME": str(tmp_path / "state"),
        "PATH": f"{scripts}:{os.environ['PATH']}",
    }


@pytest.fixture
def root() -> Path:
    """Top of the repository."""
    return ROOT
