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
def learnt_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Environment for child processes that know the interface types of the examples."""
    from rn_interfaces.finder import PREFIXES
    from rn_interfaces.learning import learn
    from rn_interfaces.sources import definitions
    from rn_interfaces.store import DefinitionStore

    monkeypatch.setenv(PREFIXES, sys.prefix)
    store = DefinitionStore(tmp_path / "data" / "roboneuron" / "interfaces")
    assert not learn(store, definitions(ROOT / "examples" / "ros")).refused
    environment = {
        **os.environ,
        "XDG_DATA_HOME": str(tmp_path / "data"),
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
        "ROS_DOMAIN_ID": str(free_ros_domain()),
    }
    del environment[PREFIXES]
    return environment


@pytest.fixture
def root() -> Path:
    """Top of the repository."""
    return ROOT
