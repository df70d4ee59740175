"""Fixtures for tests of the console: installed plugins that exist for one test only."""

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
