"""Makes the mutants of `mutants/` importable by the tests and by targets; an empty plugin site."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rn_testing.fakes.site import PluginSite, plugin_site


@pytest.fixture
def site(tmp_path: Path) -> Iterator[PluginSite]:
    """An empty plugin site."""
    with plugin_site(tmp_path / "site") as made:
        yield made
