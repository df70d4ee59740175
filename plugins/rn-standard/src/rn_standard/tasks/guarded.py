"""A monitor behind a time limit: it answers in a thread of its own, and can neither delay nor fail
a task.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from rn_standard.tasks.monitor import Monitor, Score
from roboneuron import Observation

log = logging.getLogger(__name__)
SLOW_S = 0.05
"""Longest time of an answer for which a task's own thread may wait."""
_MOST_REASON = 300
_IDLE_S = 5.0
_FRESH_S = 1.0
"""Time after the limit for which an answer counts."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MonitorAnswer:
    """What is known from a monitor at a moment.

    Attributes:
        score: None if it is absent.
        reason: the score's reason, or why it is absent; one sentence, without its full stop.
        asked_s: monotonic time of the observation that it is about [s]; None if it is absent.
    """

    score: Score | None
    reason: str
    asked_s: float | None = None


def absent(reason: str) -> MonitorAnswer:
    """No answer, for a reason."""
    return MonitorAnswer(score=None, reason=reason[:_MOST_REASON])


class GuardedMonitor:
    """Asks a monitor in a thread of its own; used by one task at a time, never blocks.

    Building it, its exceptions, answers that are no scores, and late answers make it absent, with a
    reason. An observation that comes while it works is not queued: the next one is newer.

    Args:
        build: builds the monitor, in that thread.
        limit_s: longest time of one answer [s].
        clock: monotonic time [s].

    Attributes:
        limit_s: longest time of one answer [s].
    """

    def __init__(
        self,
        build: Callable[[], Monitor],
        limit_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._build, self.limit_s, self._clock = build, limit_s, clock
        self._wake = threading.Condition()
        self._start: Observation | None = None
        self._next: tuple[Observation, float] | None = None
        self._busy_since_s: float | None = None
        self._is_loaded = False
        self._is_closed = False
        self._round = 0
        self._newest = absent("it has not been asked yet")
        self._monitor: Monitor | None = None
        self._thread: threading.Thread | None = None

    @property
    def is_busy(self) -> bool:
        """True while a call of the monitor runs, however long."""
        return self._busy_since_s is not None

    @property
    def is_idle(self) -> bool:
        """True if it has no observation to ask about."""
        with self._wake:
            return self._next is None and self._busy_since_s is None

    def reset(self, observation: Observation) -> None:
        """Begin an attempt; earlier answers no longer count."""
        with self._wake:
            self._round += 1
            self._start, self._next = observation, None
            self._newest = absent("it has not answered yet")

    def offer(self, observation: Observation, asked_s: float) -> bool:
        """Ask about an observation of that monotonic time; False if it still works on an earlier
        one.
        """
        with self._wake:
            if self._is_closed or self._busy_since_s is not None or self._next is not None:
                return False
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="monitor", daemon=True)
                self._thread.start()
            self._next = observation, asked_s
            self._wake.notify()
            return True

    def answer(self) -> MonitorAnswer:
        """The newest answer that counts."""
        now_s = self._clock()
        with self._wake:
            since_s = self._busy_since_s
            if since_s is not None and now_s - since_s > self.limit_s:
                what = "not answered" if self._is_loaded else "not been loaded"
                return absent(f"it has {what} for {now_s - since_s:.1f} s ({self._limited})")
            newest = self._newest
        if newest.asked_s is not None and now_s - newest.asked_s > self.limit_s + _FRESH_S:
            return absent(f"its newest answer is {now_s - newest.asked_s:.1f} s old")
        return newest

    def close(self) -> None:
        """End the thread once the monitor returns; idempotent."""
        with self._wake:
            self._is_closed = True
            self._next = None
            self._wake.notify()

    @property
    def _limited(self) -> str:
        return f"its limit is {self.limit_s:g} s"

    def _work(self) -> None:
        while True:
            with self._wake:
                # it ends without work, because a predicate's monitor is never closed
                self._wake.wait_for(lambda: self._is_closed or self._next is not None, _IDLE_S)
                if self._next is None:
                    self._thread = None
                    return
                (observation, asked_s), self._next = self._next, None
                begun, start, self._start = self._round, self._start, None
                self._busy_since_s = self._clock()
            answer = absent("it has not answered")
            try:
                if self._monitor is None:
                    self._monitor = self._build()
                    with self._wake:
                        self._is_loaded, self._busy_since_s = True, self._clock()
                answer = self._asked(self._monitor, start, observation, asked_s)
            except Exception as error:  # a plugin's monitor must not end the task
                log.warning("A monitor has failed: %s", error, exc_info=True)
                answer = absent(f"it has failed: {type(error).__name__}: {error}")
            finally:
                with self._wake:
                    self._busy_since_s = None
                    if begun == self._round:
                        self._newest = answer

    def _asked(
        self, monitor: Monitor, start: Observation | None, observation: Observation, asked_s: float
    ) -> MonitorAnswer:
        if start is not None:
            monitor.reset(start)
        begun_s = self._clock()
        score = monitor.score(observation)
        took_s = self._clock() - begun_s
        if took_s > self.limit_s:
            return absent(f"its answer took {took_s:.1f} s ({self._limited})")
        if wrong := _wrong(score):
            return absent(wrong)
        return MonitorAnswer(score=score, reason=score.reason[:_MOST_REASON], asked_s=asked_s)


class AskedMonitor:
    """A slow monitor as one for predicates: `score` returns its newest answer at once, None until
    there is one. Follows `Monitor`.

    Args:
        build, limit_s: as of `GuardedMonitor`.
    """

    def __init__(self, build: Callable[[], Monitor], limit_s: float) -> None:
        self._guard, self._clock = GuardedMonitor(build, limit_s), time.monotonic

    def reset(self, observation: Observation) -> None:
        """See `Monitor`."""
        self._guard.reset(observation)

    def score(self, observation: Observation) -> Score:
        """See `Monitor`."""
        self._guard.offer(observation, self._clock())
        answer = self._guard.answer()
        return answer.score or Score(value=None, reason=answer.reason)


def _wrong(score: object) -> str:
    """What is wrong with an answer; empty for a valid one."""
    if not isinstance(score, Score):
        return f"it answered {type(score).__name__}, expected a Score"
    for name in ("value", "progress", "failure"):
        value = getattr(score, name)
        if value is None:
            continue
        is_number = isinstance(value, int | float) and math.isfinite(value)
        if not (is_number and 0.0 <= value <= 1.0):
            return f"its {name} is {str(value)[:40]}, expected 0 .. 1 or None"
    if not isinstance(score.reason, str) or not score.reason:
        return "its answer has no reason"
    return ""
