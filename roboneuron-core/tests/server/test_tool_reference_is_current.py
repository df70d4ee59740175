"""docs/tools.md is what the code says."""

from __future__ import annotations

from pathlib import Path

import pytest

from roboneuron.server.reference import tools_reference

PAGE = Path(__file__).parents[3] / "docs" / "tools.md"


@pytest.mark.skipif(not PAGE.parent.is_dir(), reason="the core is tested without the repository's docs")
def test_the_tool_reference_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == tools_reference(), "run: roboneuron tools --markdown > docs/tools.md"
