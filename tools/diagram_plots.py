"""Plots of tables in docs/benchmarks.md."""

from __future__ import annotations

import re
from pathlib import Path

from diagram_sheet import AMBER, BLUE, GREEN, RED, Sheet

DOCS = Path(__file__).parents[1] / "docs"


def rows_of(heading: str) -> list[list[str]]:
    """Cells of the first table below the heading of docs/benchmarks.md that starts with
    `heading`.
    """
    text = (DOCS / "benchmarks.md").read_text(encoding="utf-8")
    _, found, section = text.partition(f"\n### {heading}")
    if not found:
        raise ValueError(f"docs/benchmarks.md has no section {heading!r}.")
    table = re.search(r"(?:^\|.*\n)+", section, re.MULTILINE)
    lines = table[0].splitlines() if table else []
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def plot_chunks() -> str:
    """Share of rows delivered, by latency and mode, with chunks of 16."""
    s = Sheet(940, 270, "Share of rows delivered in time with chunks of 16 rows, by latency")
    modes = (("sequential", AMBER), ("overlap", BLUE), ("rtc", GREEN), ("predicted-state", RED))
    table = [row for row in rows_of("Chunks with late answers") if row[0] == "16"]
    for share in (0, 50, 100):
        s.line((70, 210 - 1.6 * share), (910, 210 - 1.6 * share), head=False, dashed=share > 0)
        s.text(62, 215 - 1.6 * share, f"{share} %", small=True, anchor="end")
    for number, row in enumerate(table):
        left = 100 + 205 * number
        for place, (_, fill) in enumerate(modes):
            height = 1.6 * float(row[2 + place].partition("/")[0])
            s.bar(left + 42 * place, 210 - height, 36, height, fill)
        s.text(left + 80, 230, f"{row[1]} ms", bold=True)
    for place, (name, fill) in enumerate(modes):
        s.bar(200 + 150 * place, 244, 14, 14, fill)
        s.text(220 + 150 * place, 256, name, small=True, anchor="start")
    return s.svg()


def plot_fastv() -> str:
    """Duration of a prediction with each preset."""
    table = rows_of("Backends and presets")
    s = Sheet(
        940, 40 + 26 * len(table), "Time of a prediction by backend and preset, on one CPU thread"
    )
    longest = max(float(row[3]) for row in table)
    for number, row in enumerate(table):
        y = 22 + 26 * number
        s.text(190, y + 15, f"{row[0]}, {row[1]}", small=True, anchor="end")
        width = 620 * float(row[3]) / longest
        s.bar(200, y, width, 20, BLUE if row[0] == "oft" else AMBER)
        s.text(208 + width, y + 15, f"{float(row[3]):.0f} ms", small=True, anchor="start")
    return s.svg()


def plot_starts() -> str:
    """Start and stop times of modules."""
    table = rows_of("Starting and stopping")
    s = Sheet(940, 46 + 30 * len(table), "Time from call to proof of readiness, median")
    for number, row in enumerate(table):
        y = 20 + 30 * number
        seconds = float(row[1].split()[0])
        s.text(200, y + 16, row[0].strip("`").replace("`", ""), small=True, anchor="end")
        s.bar(210, y, 220 * seconds, 22, GREEN)
        s.text(218 + 220 * seconds, y + 16, f"{seconds:g} s", small=True, anchor="start")
    return s.svg()
