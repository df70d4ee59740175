"""ROS time of the kit, tolerances for stamps, and a jump of all clocks."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

CLOCK_OFFSET_NS = 7_200_000_000_000
"""Offset of the kit's ROS clock from the wall clock, so that a stamp reveals which clock it came
from.
"""
FUTURE_S, PAST_S = 0.02, 2.0
"""Maximum time of a stamp after its read, and before the source was opened."""


def ros_clock() -> int:
    """ROS time of the kit [ns]: the wall clock with an offset."""
    return time.time_ns() + CLOCK_OFFSET_NS


LATER_S = 3600.0
"""Time after which nothing may have changed by itself [s]."""


@contextmanager
def later() -> Iterator[None]:
    """Let `time.time` and `time.monotonic` be LATER_S ahead, as if nothing had been called for that
    time; ROS time of the kit follows. `time.perf_counter`, with which durations are measured, is
    kept.
    """
    real = {name: getattr(time, name) for name in ("time", "monotonic")}
    real |= {f"{name}_ns": getattr(time, f"{name}_ns") for name in real}
    try:
        for name, clock in real.items():
            ahead = int(LATER_S * 1e9) if name.endswith("_ns") else LATER_S
            setattr(time, name, lambda clock=clock, ahead=ahead: clock() + ahead)
        yield
    finally:
        for name, clock in real.items():
            setattr(time, name, clock)
