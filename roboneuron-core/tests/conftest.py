"""Fixtures for tests of the core: installed plugins that exist for one test only."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path

import pytest

from roboneuron.plugins.discovery import discover_from
from roboneuron.plugins.registry import Registry

HEADER = """\
from roboneuron.plugins.markers import hookimpl
from roboneuron.plugins.specs import *
from roboneuron.plugins.specs import Requirement
"""


@dataclass(frozen=True, kw_only=True)
class PluginSite:
    """A directory that looks like site-packages to `importlib.metadata` and is on `sys.path`."""

    path: Path

    def install(
        self, distribution: str, source: str, *, version: str = "1.0", value: str | None = None, header: str = HEADER
    ) -> None:
        """Write a distribution with one plugin module that holds `source`."""
        module = distribution.lower().replace("-", "_") + "_plugin"
        (self.path / f"{module}.py").write_text(header + source)
        info = self.path / f"{distribution.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
        (info / "entry_points.txt").write_text(f"[roboneuron]\n{distribution} = {value or module}\n")

    def discover(self, disabled: Collection[str] = ()) -> Registry:
        """Discover the plugins of this site only."""
        points = [p for d in distributions(path=[str(self.path)]) for p in d.entry_points if p.group == "roboneuron"]
        return discover_from(points, disabled)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PluginSite]:
    """An empty plugin site; modules imported from it are forgotten afterwards."""
    root = tmp_path / "site"
    root.mkdir()
    monkeypatch.syspath_prepend(str(root))
    before = set(sys.modules)
    yield PluginSite(path=root)
    for name in set(sys.modules) - before:
        origin = getattr(sys.modules[name], "__file__", None)
        if origin and Path(origin).is_relative_to(root):
            del sys.modules[name]
