"""ROS time of the kit, and tolerances for stamps."""

from __future__ import annotations

import time

CLOCK_OFFSET_NS = 7_200_000_000_000
"""Offset of the kit's ROS clock from the wall clock, so that a stamp reveals which clock it came
from.
"""
FUTURE_S, PAST_S = 0.02, 2.0
"""Maximum time of a stamp after its read, and before the source was opened."""


def ros_clock() -> int:
    """ROS time of the kit [ns]: the wall clock with an offset."""
    return time.time_ns() + CLOCK_OFFSET_NS
