"""The curve of a training: losses and metrics by step, one JSON object a line."""

from __future__ import annotations

import json
import math
from pathlib import Path

CURVE_FILE = "curve.jsonl"


class Curve:
    """Losses by step, averaged between two lines of the file, and metrics on held-out views."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._sums: dict[str, float] = {}
        self._count = 0

    def add(self, numbers: dict[str, float]) -> None:
        """Add the losses of one step."""
        for name, value in numbers.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1

    def flush(self, step: int, cpu_s: float) -> None:
        """Write the mean of the added losses."""
        means = {name: value / self._count for name, value in self._sums.items()}
        self.note(step, cpu_s, means)
        self._sums, self._count = {}, 0

    def note(self, step: int, cpu_s: float, numbers: dict[str, float]) -> None:
        """Write one line."""
        rounded = {
            name: value if math.isnan(value) else round(value, 5) for name, value in numbers.items()
        }
        line = {"step": step, "cpu_s": round(cpu_s, 1), **rounded}
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")


def newest_figures(curve: Path) -> dict[str, float]:
    """The newest metrics on held-out views in a training curve, by name; none without a file."""
    figures: dict[str, float] = {}
    for line in curve.read_text(encoding="utf-8").splitlines() if curve.exists() else ():
        # JSON has no NaN, the value of metrics without suitable held-out views
        figures |= {
            name: value
            for name, value in json.loads(line).items()
            if name.startswith("held_out_") and not math.isnan(value)
        }
    return figures
