"""docs/fault-matrix.md: every row names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_row_of_the_fault_matrix_names_tests_that_exist() -> None:
    lines = (ROOT / "docs" / "fault-matrix.md").read_text().splitlines()
    tables = [line for line in lines if line.startswith("|") and line.count("|") == 4]
    rows = [line for line in tables if not line.startswith(("| fault |", "|---"))]
    assert len(rows) > 20
    source = ""
    for row in rows:
        test = row.split("|")[-2]
        names = re.findall(r"`([^`]+)`", test)
        assert names, f"a row without a test: {row}"
        assert not names[-1].endswith(".py"), f"a row without a test: {row}"
        for name in names:
            if name.endswith(".py"):
                source = (ROOT / name).read_text()
                continue
            function, _, case = name.partition("[")
            for word in (function, case.rstrip("]")):
                is_function = word.startswith("test_")
                assert not word or (f"def {word}(" if is_function else f'"{word}"') in source, (
                    f"{word!r}: {row}"
                )
