"""What a module says of itself on /diagnostics: one record, filled from its threads, published by a
thread of its own.

The publishing thread is separate from the executor, so that a module which loads for a minute, or
hangs, still reports how long its executor has not turned (`loop_age_s`).
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
"""Rates are means over this time: a pause shows within it, and one late message does not."""
_EVENTS = 4096
"""Three seconds of a robot's states at 1000 Hz, the highest `state_rate_hz`, and some more."""
_SAMPLES = 256
"""Latencies that a median and a 99th percentile are computed of."""
log = logging.getLogger(__name__)


class RateMeter:
    """Events per second over the last three seconds of monotonic time.

    One thread at a time counts; any thread reads.

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
        """What the window says of the present.

        Returns:
            The mean rate [Hz], 0 when fewer than two events fell into the window; and the time
            since the newest of these [s], None without one.
        """
        now_s = time.monotonic()
        # a copy, because a deque that another thread appends to cannot be iterated over
        times = [at_s for at_s in self._times.copy() if now_s - at_s <= _WINDOW_S]
        if not times:
            return 0.0, None
        # n events bound n - 1 periods
        return (len(times) - 1) / max(1e-9, times[-1] - times[0]), now_s - times[-1]


class StatusWriter:
    """Everything a module reports; every method may be called from any thread.

    Values keep until they are set again. What changes the meaning of the report is published at
    once (`changed`), all else with the next period.

    Attributes:
        name: of the DiagnosticStatus, "<namespace>/<node name>".
        output: counts what the module publishes.
        latency: from an input's stamp to its output [ms], of the last 256; any thread appends.
        dropped: inputs that were not acted on, by a word for the reason; see `drop`.
        changed: set to have the report published now.
    """

    def __init__(self, name: str) -> None:
        """Args:
        name: of the DiagnosticStatus.
        """
        self.name = name
        self.output = RateMeter()
        self.latency: deque[float] = deque(maxlen=_SAMPLES)
        self.changed = threading.Event()
        self._started_s = self._loop_s = time.monotonic()
        # guards the dictionaries below; a leaf: nothing is called while it is held
        self._lock = threading.Lock()
        self.dropped: Counter[str] = Counter()
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

    def drop(self, reason: str) -> None:
        """Count an input that was not acted on.

        Args:
            reason: a word, such as "stale_action".
        """
        # with a lock, because `+= 1` is a reading and a writing
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
        """Not ready: `what` is missing."""
        self.set(ready=False, waiting_for=what)

    def set_ready(self) -> None:
        """The module has proved that it works."""
        self.announce(ready=True, waiting_for="")

    def set_error(self, error: Exception) -> None:
        """Remember the newest failure, until `clear_error`.

        Args:
            error: counted each time; announced at once unless it is the one that is reported
                already, so that a step that fails 20 times a second does not flood /diagnostics.
                What a plugin raised against its contract is told as a defect, with its type; its
                traceback goes to the log.
        """
        if not isinstance(error, RoboNeuronError):
            log.error("unexpected failure", exc_info=error)
            error = InternalError(f"{type(error).__name__}: {error}", hint="See the module's log.")
        with self._lock:
            self._errors += 1
        self.announce(error_code=error.code, error=error.message, error_hint=error.hint)

    def clear_error(self) -> None:
        """The module works again."""
        self.announce(error_code="", error="", error_hint="")

    def set(self, **fields: str | float | bool) -> None:
        """Report fields of `Report` by their names, with the next period.

        Args:
            fields: names that `Report` does not have make the report fail.
        """
        with self._lock:
            self._fields.update(fields)

    def announce(self, **fields: str | float | bool) -> None:
        """As `set`, at once when one of them is new."""
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
        """Report no facts of the robot any more, nor the metrics `values`: nobody knows them."""
        with self._lock:
            self._detail.clear()
            for key in values:
                self._metrics.pop(key, None)

    def tick_work(self, worker: str, limit_s: float) -> None:
        """A thread gets on.

        Args:
            worker: its name.
            limit_s: it counts as stalled when it does not say so again within this time [s].
        """
        with self._lock:
            self._work[worker] = (time.monotonic(), limit_s)

    def end_work(self, worker: str) -> None:
        """A thread has ended: it is expected to get on no more."""
        with self._lock:
            self._work.pop(worker, None)

    def tick_loop(self) -> None:
        """The executor turned; without the lock, because a float is replaced at once."""
        self._loop_s = time.monotonic()

    def report(self) -> Report:
        """Everything, as it is now.

        Numbers that are measured are asked for here; the rest is as it was last set, all of it of
        one instant.
        """
        now_s = time.monotonic()
        # a copy, because any thread may append meanwhile
        latencies = self.latency.copy()
        median_ms, p99_ms = np.percentile(latencies, [50, 99]) if latencies else (None, None)
        rate_hz, age_s = self.output.rate_and_age()
        measured: dict[str, object] = {
            "error_count": self._errors,
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
        """Report now; does nothing once ROS was shut down. Callable from any thread."""
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
            # before the report is made: a change during it has another one published
            self._status.changed.clear()
            self.publish()
