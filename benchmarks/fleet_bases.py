"""The client's state of the bases of bench_fleet.py, and their configuration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fleet_plugin import NAME, NOTE, REPEAT_HZ

STEP_S = 1.0 / REPEAT_HZ
SPEED_M_S = 0.2


@dataclass
class Base:
    """The client's state of one robot.

    Attributes:
        notes: file written by its driver.
        told: first and last number of each sequence whose call reported that it was sent
            completely.
    """

    name: str
    notes: Path
    number: int = 1
    told: list[tuple[int, int]] = field(default_factory=list)
    published: int = 0
    """Messages of those sequences, including the stop message, according to the tool's answer."""
    pid: int = 0
    failures: list[str] = field(default_factory=list)

    def arrivals(self, since: int = 0) -> list[tuple[int, float, int]]:
        """Time [ns], speed and number of each command noted, from the `since`-th on."""
        content = b""
        if self.notes.exists():
            with self.notes.open("rb") as file:
                file.seek(since * NOTE.size)
                content = file.read()
        whole = len(content) // NOTE.size * NOTE.size
        return [(at_ns, x, int(number)) for at_ns, x, number in NOTE.iter_unpack(content[:whole])]

    def count(self) -> int:
        """Number of noted commands."""
        return self.notes.stat().st_size // NOTE.size if self.notes.exists() else 0

    def sequence(self, steps: int) -> tuple[int, dict[str, Any]]:
        """The next numbers as arguments of publish_velocity_sequence; also returns the first
        number.
        """
        first, self.number = self.number, self.number + steps
        messages = [
            {"linear": {"x": SPEED_M_S, "y": float(number)}}
            for number in range(first, first + steps)
        ]
        return first, {
            "robot": self.name,
            "steps": [{"message": m, "duration_s": STEP_S} for m in messages],
        }


def write_configuration(folder: Path, bases: Iterable[Base]) -> Path:
    """One cell for each base."""
    lines = [
        'disabled_plugins = ["rn-recorder"]',
        'features = ["fleet", "tools-ros"]',
        "[server]",
        'reset_emergency_stop = "client"',
        "[supervisor]",
        "start_timeout_s = 300.0",
        f'state_directory = "{folder / "state"}"',
    ]
    for base in bases:
        lines += [f"[robots.{base.name}]", f'robot = {{name = "{NAME}", state_rate_hz = 10.0}}']
        lines += [f"[robots.{base.name}.plugins.{NAME}]", f'notes = "{base.notes}"']
    path = folder / "fleet.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
