"""benchmarks/results.toml has whole tables of existing commands; docs/benchmarks.md quotes it."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
RESULTS = tomllib.loads((ROOT / "benchmarks" / "results.toml").read_text(encoding="utf-8"))
TABLES: list[dict[str, Any]] = RESULTS["benchmark"]
PAGE = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
LANES = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tools/lanes").glob("*.py"))
NOT_MEASURED = "-"


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table["id"])
def test_a_table_is_whole(table: dict[str, Any]) -> None:
    cells = [cell for row in table["rows"] for cell in row]
    assert all(table[name] for name in ("title", "conditions", "columns", "rows"))
    assert all(len(row) == len(table["columns"]) for row in table["rows"])
    is_measured = any(isinstance(cell, int | float) for cell in cells)
    assert is_measured == ("noted" in table)
    assert is_measured or NOT_MEASURED in cells


def test_each_table_has_a_name_of_its_own() -> None:
    names = [table["id"] for table in TABLES]
    assert len(names) == len({*names})


@pytest.mark.parametrize("command", sorted({table["command"] for table in TABLES}))
def test_what_a_command_runs_exists(command: str) -> None:
    program, what, *_ = shlex.split(command)
    if program == "python":
        assert (ROOT / what).is_file()
    elif program == "make":
        assert f"\ndef {what.replace('-', '_')}(" in LANES
    else:
        assert (program, what) == ("roboneuron", "eval")


def test_the_page_quotes_the_tables() -> None:
    rows = re.findall(r"^\|.*\| ([\d-]+) \| `(.+)` \|$", PAGE, re.MULTILINE)
    quoted = [line for line in PAGE.splitlines() if line.endswith("` |")]
    assert len(rows) == len(quoted) == 10
    for (noted, command), line in zip(rows, quoted, strict=True):
        told = [table for table in TABLES if table["command"] == command]
        assert noted in {str(table["noted"]) for table in told}, line
        measured = line.split("|")[2] + line.split("|")[3]
        numbers = re.findall(r"\b\d[\d.,]*\d|\b\d\b", measured)
        known = re.findall(r"\d+(?:\.\d+)?", str([[one["rows"], one.get("notes")] for one in told]))
        assert {float(n.replace(",", "")) for n in numbers} <= {float(n) for n in known}, line
