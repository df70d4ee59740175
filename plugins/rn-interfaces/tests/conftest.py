"""A store and a cache of their own, and a learnt package: `weld_msgs`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from made_packages import WELD, write_package

from rn_interfaces.finder import PREFIXES, install
from rn_interfaces.learning import learn
from rn_interfaces.sources import definitions
from rn_interfaces.store import DefinitionStore


@pytest.fixture(scope="package")
def user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a user's data and cache, whose store this process imports from."""
    folder = tmp_path_factory.mktemp("user")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_DATA_HOME", str(folder / "data"))
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        patch.setenv(PREFIXES, f"{sys.prefix}:{DefinitionStore().prefix}")
        patch.setattr(sys, "meta_path", list(sys.meta_path))
        install()
        yield folder


@pytest.fixture(scope="package")
def store(user: Path) -> DefinitionStore:
    """That of the user, who has learnt `weld_msgs`."""
    found = DefinitionStore()
    learnt = learn(found, definitions(write_package(user / "src", "weld_msgs", WELD)))
    assert not learnt.refused
    return found
