"""docs/fault-matrix.md: every row names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("tests", "plugins/*/tests", "roboneuron-core/tests")


def test_every_row_of_the_fault_matrix_names_tests_that_exist() -> None:
    lines = (ROOT / "docs" / "fault-matrix.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if re.match(r"\| (?!fault \|)", line)]
    there = {
        name
        for folder in FOLDERS
        for path in ROOT.glob(f"{folder}/**/test_*.py")
        for name in re.findall(r"def (test_\w+)\(", path.read_text(encoding="utf-8"))
    }
    named = [re.findall(r"`(test_\w+)`", row.split("|")[-2]) for row in rows]
    assert len(rows) > 60
    assert [row for row, names in zip(rows, named, strict=True) if not names] == []
    assert {name for names in named for name in names} - there == set()
