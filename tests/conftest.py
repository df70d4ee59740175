"""Fixtures for tests that cross packages: every test has its own ROS graph and state directory."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from rn_testing.domain import free_ros_domain

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    """Compute models on one thread, because each worker of pytest-xdist would use all cores."""
    torch = sys.modules.get("torch")  # modules that need it import it at collection
    if torch is not None:
        torch.set_num_threads(1)


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


@pytest.fixture(scope="session")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """Environment variables of a user who has learnt the interface types of the examples, once for
    all tests.

    Workers of pytest-xdist share the generated files, which are named by their content.
    """
    from rn_interfaces.finder import PREFIXES
    from rn_interfaces.learning import learn
    from rn_interfaces.sources import definitions
    from rn_interfaces.store import DefinitionStore

    base = tmp_path_factory.getbasetemp()
    cache = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "user-cache"
    user = {"XDG_DATA_HOME": str(base / "user-data"), "XDG_CACHE_HOME": str(cache)}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (user | {PREFIXES: sys.prefix}).items():
            patch.setenv(name, value)
        assert not learn(DefinitionStore(), definitions(ROOT / "examples" / "ros")).refused
    return user


@pytest.fixture(scope="module")
def learnt_types(learnt: Mapping[str, str]) -> Iterator[None]:
    """Make the interface types of the examples known to this process."""
    from rn_interfaces.finder import PREFIXES, install

    with pytest.MonkeyPatch.context() as patch:
        for name, value in (learnt | {PREFIXES: sys.prefix}).items():
            patch.setenv(name, value)
        patch.setattr(sys, "meta_path", list(sys.meta_path))
        install()
        yield


@pytest.fixture
def learnt_environment(learnt: Mapping[str, str]) -> dict[str, str]:
    """Environment for child processes that know the interface types of the examples."""
    return {**os.environ, **learnt, "ROS_DOMAIN_ID": str(free_ros_domain())}


@pytest.fixture
def root() -> Path:
    """Root of the repository."""
    return ROOT
