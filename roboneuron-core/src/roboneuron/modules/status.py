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
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from roboneuron.errors import InternalError, RoboNeuronError
from roboneuron.modules.report import StatusReport, to_text
from roboneuron.modules.settings import STATUS_PERIOD_S
from roboneuron.ros.qos import STATUS
from roboneuron.ros.topics import DIAGNOSTICS

_WINDOW_S = 3.0
_SAMPLES = 256


class RateMeter:
    """Events per second over the last three seconds of monotonic time; `total` counts those since
    the start.
    """

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=4096)
        self._lock = threading.Lock()
        self.total = 0

    def tick(self) -> None:
        """Count one event now."""
        with self._lock:
            self._times.append(time.monotonic())
            self.total += 1

    def rate_hz(self) -> float:
        """Mean rate over the window; 0 when fewer than two events fell into it."""
        with self._lock:
            now = time.monotonic()
            while self._times and now - self._times[0] > _WINDOW_S:
                self._times.popleft()
            if len(self._times) < 2:
                return 0.0
            return (len(self._times) - 1) / max(1e-9, self._times[-1] - self._times[0])

    def age_s(self) -> float | None:
        """Seconds since the newest event, or None when there was none in the window's memory."""
        with self._lock:
            return time.monotonic() - self._times[-1] if self._times else None


class Samples:
    """The last 256 values of something measured in milliseconds."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=_SAMPLES)
        self._lock = threading.Lock()

    def add(self, value_ms: float) -> None:
        """Keep one value [ms]."""
        with self._lock:
            self._values.append(value_ms)

    def median_and_p99(self) -> tuple[float, float] | None:
        """Median and 99th percentile [ms], or None without values."""
        with self._lock:
            values = np.array(self._values)
        if values.size == 0:
            return None
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
        self._fields: dict[str, Any] = {"state": "unconfigured", "error_count": 0}
        self._detail: dict[str, str] = {}
        self._metrics: dict[str, str] = {}
        self._work: dict[str, tuple[float, float]] = {}

    def set_state(self, state: str) -> None:
        """Lifecycle state's label; leaving "active" ends readiness."""
        if state == "active":
            self.set(state=state)
        else:
            self.set(state=state, ready=False)
        self.changed.set()

    def set_waiting(self, what: str) -> None:
        """Not ready: `what` is missing."""
        self.set(ready=False, waiting_for=what)

    def set_ready(self) -> None:
        """The module has proved that it works."""
        with self._lock:
            if self._fields.get("ready"):
                return
            self._fields |= {"ready": True, "waiting_for": ""}
        self.changed.set()

    def set_error(self, error: RoboNeuronError) -> None:
        """Remember the newest failure; the same failure again is counted, not announced."""
        with self._lock:
            before = self._fields.copy()
            self._fields |= {
                "error_code": error.code,
                "error": error.message,
                "error_hint": error.hint,
            }
            same = before == self._fields
            self._fields["error_count"] += 1
        if not same:
            self.changed.set()

    def set_unexpected(self, error: Exception) -> None:
        """Remember what a plugin raised against its contract."""
        self.set_error(
            InternalError(f"{type(error).__name__}: {error}", hint="See the module's log.")
        )

    def clear_error(self) -> None:
        """The module works again."""
        with self._lock:
            if not self._fields.get("error_code"):
                return
            self._fields |= {"error_code": "", "error": "", "error_hint": ""}
        self.changed.set()

    def set(self, **fields: str | float | int | bool) -> None:
        """Report fields of `StatusReport` by their names."""
        with self._lock:
            self._fields.update(fields)

    def set_value(self, key: str, value: str | float | int | bool) -> None:
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

    def report(self) -> StatusReport:
        """Everything, as it is now."""
        now_s = time.monotonic()
        dropped = self.dropped.items()
        latency = self.latency.median_and_p99() or (None, None)
        age_s = self.output.age_s()
        with self._lock:
            slowest = max(
                self._work.values(), key=lambda tick: (now_s - tick[0]) / tick[1], default=None
            )
            return StatusReport(
                uptime_s=round(now_s - self._started_s, 1),
                loop_age_s=round(now_s - self._loop_s, 3),
                work_age_s=None if slowest is None else round(now_s - slowest[0], 3),
                work_limit_s=None if slowest is None else slowest[1],
                rate_hz=round(self.output.rate_hz(), 2),
                latency_ms=latency[0],
                latency_p99_ms=latency[1],
                age_ms=None if age_s is None else round(age_s * 1e3, 1),
                published=self.output.total,
                dropped=sum(dropped.values()),
                dropped_by=dropped,
                detail=dict(self._detail),
                metrics=dict(self._metrics),
                **self._fields,
            )

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


class StatusReporter:
    """Publishes a StatusWriter every STATUS_PERIOD_S, and at once after a change."""

    def __init__(self, node: Node, status: StatusWriter) -> None:
        self._node = node
        self._status = status
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, STATUS)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="status", daemon=True)

    def start(self) -> None:
        """Start reporting."""
        self._thread.start()

    def publish(self) -> None:
        """Report now."""
        message = DiagnosticArray(status=[self._status.to_message()])
        message.header.stamp = self._node.get_clock().now().to_msg()
        if self._node.context.ok():
            self._publisher.publish(message)

    def stop(self) -> None:
        """Stop reporting and wait for the thread."""
        self._stop.set()
        self._status.changed.set()
        if self._thread.is_alive():
            self._thread.join(timeout=1.0)

    def _run(self) -> None:
        while not self._stop.is_set():
            self._status.changed.wait(STATUS_PERIOD_S)
            self._status.changed.clear()
            if self._node.context.ok():
                self.publish()
