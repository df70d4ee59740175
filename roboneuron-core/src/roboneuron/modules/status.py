"""What a module says of itself on /diagnostics: one record, filled from its threads, published by a
thread of its own.

The publishing thread is separate from the executor, so that a module which loads for a minute, or
hangs, still reports how long its executor has not turned (`loop_age_s`).
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from roboneuron.errors import InternalError, RoboNeuronError
from roboneuron.modules.report import Report, to_text
from roboneuron.modules.settings import STATUS_PERIOD_S
from roboneuron.ros.qos import STATUS
from roboneuron.ros.topics import DIAGNOSTICS

_WINDOW_S = 3.0
_SAMPLES = 256


class RateMeter:
    """Events per second over the last three seconds of monotonic time; `total` counts those since
    the start. One thread at a time counts.
    """

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=4096)
        self.total = 0

    def tick(self) -> None:
        """Count one event now."""
        self._times.append(time.monotonic())
        self.total += 1

    def rate_and_age(self) -> tuple[float, float | None]:
        """Mean rate over the window [Hz], 0 when fewer than two events fell into it; and the time
        since the newest of these [s].
        """
        now_s = time.monotonic()
        times = [at_s for at_s in self._times.copy() if now_s - at_s <= _WINDOW_S]
        if not times:
            return 0.0, None
        return (len(times) - 1) / max(1e-9, times[-1] - times[0]), now_s - times[-1]


class Samples:
    """The last 256 values of something measured in milliseconds; any thread adds one."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=_SAMPLES)
        self.add = self._values.append

    def median_and_p99(self) -> tuple[float | None, float | None]:
        """Median and 99th percentile [ms], None without values."""
        values = self._values.copy()
        if not values:
            return None, None
        median, p99 = np.percentile(values, [50, 99])
        return float(median), float(p99)


class Counts:
    """Named counters that never go down ("stale", "non_finite" ...)."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    def add(self, name: str) -> None:
        """Count one event of that name."""
        with self._lock:
            self._counts[name] += 1

    def items(self) -> dict[str, int]:
        """A copy of all counters."""
        with self._lock:
            return dict(self._counts)


class StatusWriter:
    """Everything a module reports; every method may be called from any thread."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.output = RateMeter()
        self.latency = Samples()
        self.dropped = Counts()
        self.changed = threading.Event()
        self._started_s = self._loop_s = time.monotonic()
        self._lock = threading.Lock()
        self._fields: dict[str, str | float | bool] = {
            "state": "unconfigured",
            "error_code": "",
            "error": "",
            "error_hint": "",
        }
        self._errors = 0
        self._detail: dict[str, str] = {}
        self._metrics: dict[str, str] = {}
        self._work: dict[str, tuple[float, float]] = {}

    def set_state(self, state: str) -> None:
        """Lifecycle state's label; leaving "active" ends readiness."""
        if state != "active":
            self.set(ready=False)
        self._announce(state=state)

    def set_waiting(self, what: str) -> None:
        """Not ready: `what` is missing."""
        self.set(ready=False, waiting_for=what)

    def set_ready(self) -> None:
        """The module has proved that it works."""
        self._announce(ready=True, waiting_for="")

    def set_error(self, error: RoboNeuronError) -> None:
        """Remember the newest failure; the same failure again is counted, not announced."""
        with self._lock:
            self._errors += 1
        self._announce(error_code=error.code, error=error.message, error_hint=error.hint)

    def set_unexpected(self, error: Exception) -> None:
        """Remember what a plugin raised against its contract."""
        self.set_error(
            InternalError(f"{type(error).__name__}: {error}", hint="See the module's log.")
        )

    def clear_error(self) -> None:
        """The module works again."""
        self._announce(error_code="", error="", error_hint="")

    def set(self, **fields: str | float | bool) -> None:
        """Report fields of `Report` by their names."""
        with self._lock:
            self._fields.update(fields)

    def _announce(self, **fields: str | bool) -> None:
        """Report these fields, at once when they are new."""
        with self._lock:
            is_new = not fields.items() <= self._fields.items()
            self._fields.update(fields)
        if is_new:
            self.changed.set()

    def set_value(self, key: str, value: str | float | bool) -> None:
        """Report one more value among the metrics."""
        with self._lock:
            self._metrics[key] = to_text(value)

    def set_details(self, details: Mapping[str, str]) -> None:
        """Report facts of the robot or simulator."""
        with self._lock:
            self._detail.update(details)

    def forget_details(self, *values: str) -> None:
        """Report no facts of the robot any more, nor the metrics `values`: nobody knows them."""
        with self._lock:
            self._detail.clear()
            for key in values:
                self._metrics.pop(key, None)

    def tick_work(self, worker: str, limit_s: float) -> None:
        """A thread gets on; it is stalled when it does not say so again within `limit_s`."""
        with self._lock:
            self._work[worker] = (time.monotonic(), limit_s)

    def end_work(self, worker: str) -> None:
        """A thread has ended."""
        with self._lock:
            self._work.pop(worker, None)

    def tick_loop(self) -> None:
        """The executor turned."""
        self._loop_s = time.monotonic()

    def report(self) -> Report:
        """Everything, as it is now."""
        now_s = time.monotonic()
        dropped = self.dropped.items()
        latency_ms, latency_p99_ms = self.latency.median_and_p99()
        rate_hz, age_s = self.output.rate_and_age()
        measured: dict[str, object] = {
            "error_count": self._errors,
            "uptime_s": round(now_s - self._started_s, 1),
            "loop_age_s": round(now_s - self._loop_s, 3),
            "rate_hz": round(rate_hz, 2),
            "latency_ms": latency_ms,
            "latency_p99_ms": latency_p99_ms,
            "age_ms": None if age_s is None else round(age_s * 1e3, 1),
            "published": self.output.total,
            "dropped": sum(dropped.values()),
            "dropped_by": dropped,
        }
        with self._lock:
            work = list(self._work.values())
            told = {**self._fields, "detail": dict(self._detail), "metrics": dict(self._metrics)}
        if work:
            at_s, limit_s = max(work, key=lambda tick: (now_s - tick[0]) / tick[1])
            measured |= {"work_age_s": round(now_s - at_s, 3), "work_limit_s": limit_s}
        return Report.model_validate({**measured, **told})

    def to_message(self) -> DiagnosticStatus:
        """The report as a DiagnosticStatus."""
        report = self.report()
        failure = report.failure()
        return DiagnosticStatus(
            level=DiagnosticStatus.ERROR if failure else DiagnosticStatus.OK,
            name=self.name,
            message=str(failure) if failure else report.state,
            hardware_id=str(os.getpid()),
            values=[KeyValue(key=key, value=text) for key, text in report.to_values().items()],
        )


class StatusReporter(threading.Thread):
    """Publishes a StatusWriter every STATUS_PERIOD_S, and at once after a change; from `start` to
    `stop`.
    """

    def __init__(self, node: Node, status: StatusWriter) -> None:
        super().__init__(name="status", daemon=True)
        self._node = node
        self._status = status
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, STATUS)
        self._end = threading.Event()

    def publish(self) -> None:
        """Report now."""
        message = DiagnosticArray(status=[self._status.to_message()])
        message.header.stamp = self._node.get_clock().now().to_msg()
        if self._node.context.ok():
            self._publisher.publish(message)

    def stop(self) -> None:
        """Stop reporting and wait for the thread."""
        self._end.set()
        self._status.changed.set()
        if self.is_alive():
            self.join(timeout=1.0)

    def run(self) -> None:
        """Report until `stop`."""
        while not self._end.is_set():
            self._status.changed.wait(STATUS_PERIOD_S)
            self._status.changed.clear()
            self.publish()
