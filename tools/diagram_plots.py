"""Plots of tables in benchmarks/results.toml."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from diagram_sheet import AMBER, BLUE, GREEN, RED, Sheet

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def rows_of(name: str) -> list[dict[str, Any]]:
    """Rows of the benchmark `name`, each with its cells by column."""
    results = tomllib.loads((ROOT / "benchmarks" / "results.toml").read_text(encoding="utf-8"))
    [table] = [one for one in results["benchmark"] if one["id"] == name]
    return [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]


def plot_chunks() -> str:
    """Share of rows delivered, by latency and mode, with chunks of 16."""
    s = Sheet(940, 270, "Share of rows delivered in time with chunks of 16 rows, by latency")
    modes = {"sequential": AMBER, "overlap": BLUE, "rtc": GREEN, "predicted-state": RED}
    rows = [row for row in rows_of("chunks") if row["chunk_rows"] == 16]
    for share in (0, 50, 100):
        s.line((70, 210 - 1.6 * share), (910, 210 - 1.6 * share), head=False, dashed=share > 0)
        s.text(62, 215 - 1.6 * share, f"{share} %", small=True, anchor="end")
    for number, latency_ms in enumerate(dict.fromkeys(row["latency_ms"] for row in rows)):
        left = 100 + 205 * number
        shares = {
            row["mode"]: row["in_time_pct"] for row in rows if row["latency_ms"] == latency_ms
        }
        for place, (mode, fill) in enumerate(modes.items()):
            height = 1.6 * shares[mode]
            s.bar(left + 42 * place, 210 - height, 36, height, fill)
        s.text(left + 80, 230, f"{latency_ms} ms", bold=True)
    for place, (mode, fill) in enumerate(modes.items()):
        s.bar(200 + 150 * place, 244, 14, 14, fill)
        s.text(220 + 150 * place, 256, mode, small=True, anchor="start")
    return s.svg()


def plot_fastv() -> str:
    """Duration of a prediction with each preset."""
    rows = rows_of("vla")
    s = Sheet(
        940, 40 + 26 * len(rows), "Time of a prediction by backend and preset, on one CPU thread"
    )
    longest = max(row["ms"] for row in rows)
    for number, row in enumerate(rows):
        y = 22 + 26 * number
        s.text(190, y + 15, f"{row['backend']}, {row['preset']}", small=True, anchor="end")
        width = 620 * row["ms"] / longest
        s.bar(200, y, width, 20, BLUE if row["backend"] == "oft" else AMBER)
        s.text(208 + width, y + 15, f"{row['ms']:.0f} ms", small=True, anchor="start")
    return s.svg()


def plot_starts() -> str:
    """Start and stop times of modules."""
    rows = rows_of("starts")
    s = Sheet(940, 46 + 30 * len(rows), "Time from call to proof of readiness, median")
    for number, row in enumerate(rows):
        y = 20 + 30 * number
        seconds = row["median_s"]
        s.text(200, y + 16, row["what"], small=True, anchor="end")
        s.bar(210, y, 220 * seconds, 22, GREEN)
        s.text(218 + 220 * seconds, y + 16, f"{seconds:g} s", small=True, anchor="start")
    return s.svg()
