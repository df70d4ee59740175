"""Installed plugins that exist for one test only."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import distributions
from pathlib import Path

from roboneuron.command import discover
from roboneuron.feature import Registry

HEADER = """\
from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import *
from roboneuron.plugins.specs import Requirement
"""
"""First lines of a plugin module written by `PluginSite.install`."""


@dataclass(frozen=True, kw_only=True)
class PluginSite:
    """A directory that `importlib.metadata` treats as site-packages, on `sys.path`."""

    path: Path

    def install(
        self,
        distribution: str,
        source: str,
        *,
        version: str = "1.0",
        value: str | None = None,
        header: str = HEADER,
    ) -> None:
        """Write a distribution with one plugin module containing `source`."""
        self.path.mkdir(exist_ok=True)
        module = distribution.lower().replace("-", "_") + "_plugin"
        (self.path / f"{module}.py").write_text(header + source)
        info = self.path / f"{distribution.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n"
        )
        (info / "entry_points.txt").write_text(
            f"[roboneuron]\n{distribution} = {value or module}\n"
        )

    def discover(self, disabled: Collection[str] = ()) -> Registry:
        """Discover the plugins of this site only."""
        points = [
            p
            for d in distributions(path=[str(self.path)])
            for p in d.entry_points
            if p.group == "roboneuron"
        ]
        return discover(disabled, points=points)


@contextmanager
def plugin_site(path: Path) -> Iterator[PluginSite]:
    """A new site in `path`, first on `sys.path`; modules imported from it are removed at the
    end.
    """
    path.mkdir()
    sys.path.insert(0, str(path))
    before = set(sys.modules)
    try:
        yield PluginSite(path=path)
    finally:
        sys.path.remove(str(path))
        for name in set(sys.modules) - before:
            origin = getattr(sys.modules[name], "__file__", None)
            if origin and Path(origin).is_relative_to(path):
                del sys.modules[name]
