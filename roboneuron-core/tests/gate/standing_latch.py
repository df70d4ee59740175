"""A latch with stopped clocks."""

from __future__ import annotations

from pathlib import Path

from roboneuron.estop import EmergencyStopLatch

TIME_NS = 1_700_000_000_000_000_000
NOWHERE = Path("/proc/nothing/stop")
"""A path that cannot be created."""


def a_latch(path: Path) -> EmergencyStopLatch:
    """A latch as in another process, with stopped clocks."""
    return EmergencyStopLatch(path, lambda: TIME_NS, lambda: 100.0)
