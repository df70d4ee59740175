"""ROS time of the kit, and how far a stamp may lie from it."""

from __future__ import annotations

import time

CLOCK_OFFSET_NS = 7_200_000_000_000
"""How far the kit's ROS clock is from the wall clock, so that a stamp tells which one it was taken
from.
"""
FUTURE_S, PAST_S = 0.02, 2.0
"""How far a stamp may lie after the moment of its read, and before the source was opened."""


def ros_clock() -> int:
    """ROS time of the kit [ns]: it runs as the wall clock does, at another hour."""
    return time.time_ns() + CLOCK_OFFSET_NS
