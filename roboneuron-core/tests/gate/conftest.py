"""Fixtures of the gate tests: clocks that tests turn, a latch and an audit in an empty
directory.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from roboneuron.gate import AuditLog, EmergencyStopLatch


@dataclass
class Clock:
    """Monotonic seconds and wall-clock nanoseconds that only a test moves."""

    now_s: float = 100.0
    start_ns: int = 1_700_000_000_000_000_000
    ticks: int = field(default=0)

    def monotonic(self) -> float:
        return self.now_s

    def wall_ns(self) -> int:
        self.ticks += 1
        return self.start_ns + self.ticks


@pytest.fixture
def clock() -> Clock:
    """A clock at rest."""
    return Clock()


@pytest.fixture
def latch(tmp_path: Path, clock: Clock) -> EmergencyStopLatch:
    """A latch in an empty directory."""
    return EmergencyStopLatch(tmp_path / "state" / "stop", clock.wall_ns)


@pytest.fixture
def audit(tmp_path: Path, clock: Clock) -> AuditLog:
    """An audit in an empty directory."""
    return AuditLog(tmp_path / "state" / "audit.jsonl", clock.wall_ns)
