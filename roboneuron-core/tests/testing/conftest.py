"""Makes the deliberately broken plugins of `broken/` importable by the targets that name them."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def broken_plugins_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """`broken_backends:NoReset` and the like can be imported."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "broken"))
