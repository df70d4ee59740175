"""Regularity of sent rows: rate, starved periods, gaps, jumps at chunk borders."""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass

from roboneuron.modules.inference import execution

_WINDOW = 512
"""Window of rows for the rate and jumps; counters are unlimited."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RowDelivery:
    """Statistics of sent rows.

    Attributes:
        rate: ratio of sent to wanted rows, 0 .. 1, over the last rows; pauses without an
            instruction do not count.
        starved_periods: periods without a row, since the start.
        longest_gap_s: between two rows [s], since the start.
        border_jump_mm, inner_jump_mm: mean change of the translation from row to row [mm], at the
            first row of an answer and elsewhere; None without data.
    """

    rate: float | None
    starved_periods: int
    longest_gap_s: float
    border_jump_mm: float | None
    inner_jump_mm: float | None


class DeliveryMeter:
    """Collects sent rows. Used under its owner's lock."""

    def __init__(self) -> None:
        self._spent_s: deque[float] = deque(maxlen=_WINDOW)
        self._wanted_s: deque[float] = deque(maxlen=_WINDOW)
        self._jumps: dict[bool, deque[float]] = {
            True: deque(maxlen=_WINDOW),
            False: deque(maxlen=_WINDOW),
        }
        self._last: tuple[float, execution.Row] | None = None
        self.starved_periods = 0
        self.longest_gap_s = 0.0

    def pause(self) -> None:
        """Pause the measurement: the time until the next row is not a gap."""
        self._last = None

    def add(self, row: execution.Row, now_s: float, *, moves_tcp: bool = True) -> None:
        """Add a row sent at that monotonic time [s]; `moves_tcp`: it is a TCP delta."""
        if self._last is not None:
            last_s, last = self._last
            gap_s = now_s - last_s
            self._spent_s.append(gap_s)
            self._wanted_s.append(row.step_s)
            # Half a period late is jitter; only a period without any row is starvation.
            self.starved_periods += max(0, int(gap_s / row.step_s + 0.5) - 1)
            self.longest_gap_s = max(self.longest_gap_s, gap_s)
            if moves_tcp:
                jump_m = math.dist(row.vector[:3].tolist(), last.vector[:3].tolist())
                self._jumps[row.is_border].append(jump_m * 1e3)
        self._last = (now_s, row)

    def delivery(self) -> RowDelivery:
        """Statistics since the start."""
        spent_s, wanted_s = sum(self._spent_s), sum(self._wanted_s)
        border, inner = (
            statistics.fmean(j) if j else None for j in (self._jumps[True], self._jumps[False])
        )
        return RowDelivery(
            rate=min(1.0, wanted_s / spent_s) if spent_s > 0 else None,
            starved_periods=self.starved_periods,
            longest_gap_s=self.longest_gap_s,
            border_jump_mm=border,
            inner_jump_mm=inner,
        )
