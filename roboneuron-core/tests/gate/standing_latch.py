"""A latch whose clocks stand still."""

from __future__ import annotations

from pathlib import Path

from roboneuron.estop import EmergencyStopLatch

TIME_NS = 1_700_000_000_000_000_000
NOWHERE = Path("/proc/nothing/stop")
"""A path that cannot be made."""


def a_latch(path: Path) -> EmergencyStopLatch:
    """As in another process; its clocks stand still."""
    return EmergencyStopLatch(path, lambda: TIME_NS, lambda: 100.0)
