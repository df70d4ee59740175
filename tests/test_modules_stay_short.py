"""No module, including tests, is too long to be understood as a whole."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PATTERNS = (
    "*/src/**/*.py",
    "plugins/*/src/**/*.py",
    "benchmarks/*.py",
    "tools/*.py",
    "tests/**/*.py",
    "*/tests/**/*.py",
    "plugins/*/tests/**/*.py",
    "conftest.py",
    "plugins/conftest.py",
)
MOST_LINES = 400
"""A longer module has two subjects."""


def _too_long(root: Path) -> list[str]:
    """Modules of more than MOST_LINES lines, with their number of lines."""
    counts = {
        path.relative_to(root): len(path.read_text(encoding="utf-8").splitlines())
        for pattern in PATTERNS
        for path in root.glob(pattern)
    }
    assert counts, f"no module was found below {root}"
    return sorted(f"{path}: {count} lines" for path, count in counts.items() if count > MOST_LINES)


def test_no_module_is_longer_than_400_lines():
    assert _too_long(ROOT) == [], "divide each by subject, with names that say what it holds"


@pytest.mark.parametrize(
    "place",
    [
        "core/src/core/a.py",
        "plugins/b/src/b/c/d.py",
        "benchmarks/e.py",
        "tools/f.py",
        "tests/peers/conftest.py",
        "core/tests/gate/test_g.py",
        "plugins/b/tests/c/h_cell.py",
        "plugins/conftest.py",
    ],
)
def test_a_module_that_has_grown_is_named(tmp_path, place):
    path = tmp_path / place
    path.parent.mkdir(parents=True)
    path.write_text("x = 1\n" * MOST_LINES)
    assert _too_long(tmp_path) == []
    path.write_text("x = 1\n" * (MOST_LINES + 1))
    assert _too_long(tmp_path) == [f"{place}: 401 lines"]
