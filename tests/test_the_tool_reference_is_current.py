"""docs/tools.md matches the code."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_tool_reference_is_current() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "tool_reference.py"), "--check"], timeout=120
    )
    assert done.returncode == 0, "run: python tools/tool_reference.py"
