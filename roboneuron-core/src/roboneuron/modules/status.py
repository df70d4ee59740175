"""Status of a module on /diagnostics: one record, filled from its threads and published by a
separate thread.

Because the publishing thread is not the executor, a module that loads for a minute, or hangs, still
reports for how long its executor has been blocked (`loop_age_s`).
"""

from __future__ import annotations

import logging
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
"""Averaging window of rates: long enough to ignore one late message, short enough to show a pause.
"""
_EVENTS = 4096
"""Capacity for three seconds of robot states at 1000 Hz, the highest `state_rate_hz`."""
_SAMPLES = 256
"""Number of latencies used for the median and the 99th percentile."""
log = logging.getLogger(__name__)


class RateMeter:
    """Events per second over the last three seconds of monotonic time.

    One thread at a time counts; any thread may read.

    Attributes:
        total: events since the start.
    """

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_EVENTS)
        self.total = 0

    def tick(self) -> None:
        """Count one event now."""
        self._times.append(time.monotonic())
        self.total += 1

    def rate_and_age(self) -> tuple[float, float | None]:
        """Return the rate and age of the events in the window.

        Returns:
            The mean rate [Hz], 0 for fewer than two events in the window; and the time since the
            newest of these [s], None without one.
        """
        now_s = time.monotonic()
        # a copy, because a deque that another thread appends to cannot be iterated over
        times = [at_s for at_s in self._times.copy() if now_s - at_s <= _WINDOW_S]
        if not times:
            return 0.0, None
        # n events bound n - 1 periods
        return (len(times) - 1) / max(1e-9, times[-1] - times[0]), now_s - times[-1]


class StatusWriter:
    """Collects everything a module reports; every method may be called from any thread.

    Values persist until they are set again. A change of the meaning of the report is published at
    once (`changed`), all else with the next period.

    Attributes:
        name: name of the DiagnosticStatus, "<namespace>/<node name>".
        output: counts the module's published messages.
        latency: time from an input's stamp to its output [ms], for the last 256; any thread
            appends.
        dropped: number of inputs that were not acted on, by reason; see `drop`.
        changed: set to publish the report now.
    """

    def __init__(self, name: str) -> None:
        """Args:
        name: name of the DiagnosticStatus.
        """
        self.name = name
        self.output = RateMeter()
        self.latency: deque[float] = deque(maxlen=_SAMPLES)
        self.changed = threading.Event()
        self._started_s = self._loop_s = time.monotonic()
        # guards the dictionaries below; a leaf lock: nothing is called while it is held
        self._lock = threading.Lock()
        self.dropped: Counter[str] = Counter()
        self._fields: dict[str, str | float | bool] = {
            "state": "unconfigured",
            "error_code": "",
            "error": "",
            "error_hint": "",
        }
        self._errors = self._events = 0
        self._detail: dict[str, str] = {}
        self._metrics: dict[str, str] = {}
        self._work: dict[str, tuple[float, float]] = {}

    def drop(self, reason: str) -> None:
        """Count an input that was not acted on.

        Args:
            reason: a word, such as "stale_action".
        """
        # with a lock, because `+= 1` is a read and a write
        with self._lock:
            self.dropped[reason] += 1

    def set_state(self, state: str) -> None:
        """Report the label of the lifecycle state.

        Args:
            state: leaving "active" ends readiness, which has to be proved again.
        """
        if state != "active":
            self.set(ready=False)
        self.announce(state=state)

    def set_waiting(self, what: str) -> None:
        """Report that the module is not ready because `what` is missing."""
        self.set(ready=False, waiting_for=what)

    def set_ready(self) -> None:
        """Report that the module has passed its readiness check."""
        self.announce(ready=True, waiting_for="")

    def set_error(self, error: Exception) -> None:
        """Keep the newest failure until `clear_error`.

        Args:
            error: counted each time. It is announced at once unless the same error is already
                reported, so that a step that fails 20 times a second does not flood /diagnostics.
                An exception outside a plugin's contract is reported as a defect, with its type; its
                traceback goes to the log.
        """
        if not isinstance(error, RoboNeuronError):
            log.error("unexpected failure", exc_info=error)
            error = InternalError(f"{type(error).__name__}: {error}", hint="See the module's log.")
        with self._lock:
            self._errors += 1
        self.announce(error_code=error.code, error=error.message, error_hint=error.hint)

    def clear_error(self) -> None:
        """Report that the module works again."""
        self.announce(error_code="", error="", error_hint="")

    def tell(self, event: str, text: str) -> None:
        """Report at once an event that is no error; the server passes it on to its features.

        Args:
            event: a word, such as "fallback".
            text: explanation.
        """
        with self._lock:
            self._events += 1
            self._fields |= {"event": event, "event_text": text}
        self.changed.set()

    def set(self, **fields: str | float | bool) -> None:
        """Report fields of `Report` by their names, with the next period.

        Args:
            fields: names that `Report` does not have make the report fail.
        """
        with self._lock:
            self._fields.update(fields)

    def announce(self, **fields: str | float | bool) -> None:
        """Like `set`, but published at once if a value is new."""
        with self._lock:
            is_new = not fields.items() <= self._fields.items()
            self._fields.update(fields)
        if is_new:
            self.changed.set()

    def set_value(self, key: str, value: str | float | bool) -> None:
        """Report one more value among the metrics, with the next period.

        Args:
            key: without the prefix of a table, see `Report`.
            value: written as `to_text` does.
        """
        with self._lock:
            self._metrics[key] = to_text(value)

    def set_details(self, details: Mapping[str, str]) -> None:
        """Report facts of the robot or simulator."""
        with self._lock:
            self._detail.update(details)

    def forget_details(self, *values: str) -> None:
        """Stop reporting facts of the robot and the metrics `values`, because they are unknown."""
        with self._lock:
            self._detail.clear()
            for key in values:
                self._metrics.pop(key, None)

    def tick_work(self, worker: str, limit_s: float) -> None:
        """Report that a thread makes progress.

        Args:
            worker: name of the thread.
            limit_s: the thread counts as stalled without another call within this time [s].
        """
        with self._lock:
            self._work[worker] = (time.monotonic(), limit_s)

    def end_work(self, worker: str) -> None:
        """Report that a thread has ended, so that no progress is expected."""
        with self._lock:
            self._work.pop(worker, None)

    def tick_loop(self) -> None:
        """Record a tick of the executor; without the lock, because assigning a float is atomic."""
        self._loop_s = time.monotonic()

    def report(self) -> Report:
        """Return the complete report.

        Measured numbers are computed now; all else is as last set, consistent at one instant.
        """
        now_s = time.monotonic()
        # a copy, because any thread may append meanwhile
        latencies = self.latency.copy()
        median_ms, p99_ms = np.percentile(latencies, [50, 99]) if latencies else (None, None)
        rate_hz, age_s = self.output.rate_and_age()
        measured: dict[str, object] = {
            "error_count": self._errors,
            "event_count": self._events,
            "uptime_s": round(now_s - self._started_s, 1),
            "loop_age_s": round(now_s - self._loop_s, 3),
            "rate_hz": round(rate_hz, 2),
            "latency_ms": median_ms,
            "latency_p99_ms": p99_ms,
            "age_ms": None if age_s is None else round(age_s * 1e3, 1),
            "published": self.output.total,
        }
        with self._lock:
            work = list(self._work.values())
            told = {
                **self._fields,
                "dropped": self.dropped.total(),
                "dropped_by": dict(self.dropped),
                "detail": dict(self._detail),
                "metrics": dict(self._metrics),
            }
        if work:
            # the thread that has used the largest share of its own limit
            at_s, limit_s = max(work, key=lambda tick: (now_s - tick[0]) / tick[1])
            measured |= {"work_age_s": round(now_s - at_s, 3), "work_limit_s": limit_s}
        return Report.model_validate({**measured, **told})

    def to_message(self) -> DiagnosticStatus:
        """Return the report as a DiagnosticStatus."""
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
    """Publish a StatusWriter every STATUS_PERIOD_S, and at once after a change; from `start` to
    `stop`.
    """

    def __init__(self, node: Node, status: StatusWriter) -> None:
        """Args:
        node: publishes on /diagnostics.
        status: what is published.
        """
        super().__init__(name="status", daemon=True)
        self._node = node
        self._status = status
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, STATUS)
        self._end = threading.Event()

    def publish(self) -> None:
        """Publish the report now; does nothing after ROS was shut down. Callable from any
        thread.
        """
        message = DiagnosticArray(status=[self._status.to_message()])
        message.header.stamp = self._node.get_clock().now().to_msg()
        if self._node.context.ok():
            self._publisher.publish(message)

    def stop(self) -> None:
        """Stop reporting and wait for the thread, for at most a second."""
        self._end.set()
        self._status.changed.set()
        if self.is_alive():
            self.join(timeout=1.0)

    def run(self) -> None:
        """Report until `stop`."""
        while not self._end.is_set():
            self._status.changed.wait(STATUS_PERIOD_S)
            # before the report is made: a change during it triggers another one
            self._status.changed.clear()
            self.publish()
