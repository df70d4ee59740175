"""Number of physics steps due, to keep simulated time in step with the wall clock. Pure arithmetic
on given times.
"""

from __future__ import annotations

_TICK_S = 1.0 / 120.0
"""Time between two wake-ups, two physics steps: with one step the load was 25 % of a core instead
of 16 %.
"""
_WINDOW_S = 1.0


class Pace:
    """Counts steps against a monotonic clock; time that cannot be caught up is dropped, so that
    time never races.

    Attributes:
        achieved_factor: simulated seconds per wall second during the last whole second; the
            requested factor before that.
    """

    def __init__(self, *, step_s: float, factor: float = 1.0, catch_up_s: float = 0.05) -> None:
        """`step_s` is simulated time per step [s], `factor` the requested simulated seconds per
        second.

        At most `catch_up_s` of wall time is caught up at once.
        """
        self._period_s = step_s / factor
        self._step_s = step_s
        self._least_batch = max(1, round(_TICK_S / self._period_s))
        self._largest_batch = max(1, round(catch_up_s / self._period_s))
        self._next_s: float | None = None
        self._window_start_s = 0.0
        self._window_steps = 0
        self.achieved_factor = factor

    def due_steps(self, now_s: float) -> int:
        """Number of steps due now (monotonic time [s]), at most `catch_up_s` worth; they count as
        executed.
        """
        if self._next_s is None:
            self._next_s = self._window_start_s = now_s
        steps = int((now_s - self._next_s) / self._period_s) if now_s > self._next_s else 0
        if steps > self._largest_batch:
            steps = self._largest_batch
            self._next_s = now_s
        else:
            self._next_s += steps * self._period_s
        self._window_steps += steps
        elapsed_s = now_s - self._window_start_s
        if elapsed_s >= _WINDOW_S:
            self.achieved_factor = self._window_steps * self._step_s / elapsed_s
            self._window_start_s, self._window_steps = now_s, 0
        return steps

    def until_next_s(self, now_s: float) -> float:
        """Time until the next batch of steps, at least 1/120 s worth, is due [s], >= 0."""
        return max(0.0, (self._next_s or now_s) + self._least_batch * self._period_s - now_s)
