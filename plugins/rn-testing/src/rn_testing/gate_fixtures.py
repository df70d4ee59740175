"""Pytest fixtures: an emergency stop and an audit in the test's own directory, and their clock."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from roboneuron.feature import AuditLog, estop


@dataclass
class Clock:
    """Monotonic seconds and wall-clock nanoseconds under control of the test."""

    now_s: float = 100.0
    start_ns: int = 1_700_000_000_000_000_000
    ticks: int = field(default=0)

    def monotonic(self) -> float:
        """Current time [s]."""
        return self.now_s

    def wall_ns(self) -> int:
        """A later time at each call [ns]."""
        self.ticks += 1
        return self.start_ns + self.ticks


@pytest.fixture
def clock() -> Clock:
    """A clock that does not advance."""
    return Clock()


@pytest.fixture
def latch(tmp_path: Path, clock: Clock) -> estop.EmergencyStopLatch:
    """A latch in an empty directory."""
    return estop.EmergencyStopLatch(tmp_path / "state" / "stop", clock.wall_ns)


@pytest.fixture
def audit(tmp_path: Path, clock: Clock) -> AuditLog:
    """An audit in an empty directory."""
    return AuditLog(tmp_path / "state" / "audit.jsonl", clock.wall_ns)
