"""Installed plugins are read once, and again if a folder of the import path has changed."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path

import pytest

from roboneuron.plugins.discovery import discover


def add_plugin(folder: Path, name: str) -> None:
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[roboneuron]\n{name} = no_module_{name}\n")
    # a folder may be created within the resolution of its timestamp
    os.utime(folder, ns=(0, folder.stat().st_mtime_ns + 1))
    importlib.invalidate_caches()


def names() -> set[str]:
    return {plugin.name for plugin in discover().plugins}


def test_a_second_look_reads_nothing_until_a_folder_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = discover()
    assert discover() is before
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    add_plugin(tmp_path, "first")
    assert names() - {plugin.name for plugin in before.plugins} == {"first"}
    add_plugin(tmp_path, "second")
    assert "second" in names()


def test_what_is_disabled_is_looked_for_apart() -> None:
    everything = discover()
    name = everything.plugins[0].name
    assert discover((name,)) is not everything
    assert discover().plugins == everything.plugins
