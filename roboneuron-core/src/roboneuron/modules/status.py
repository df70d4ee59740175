"""What a module says of itself on /diagnostics: one record, filled from its threads, published by a thread of its own.

The publishing thread is separate from the executor, so that a module which loads for a minute, or hangs, still reports
how long its executor has not turned (`loop_age_s`).
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from roboneuron.errors import RoboNeuronError
from roboneuron.modules.meters import Counts, RateMeter, Samples
from roboneuron.modules.settings import STATUS_PERIOD_S, StatusKey
from roboneuron.ros.qos import STATUS
from roboneuron.ros.topics import DIAGNOSTICS


class ModuleStatus:
    """Everything a module reports; every method may be called from any thread."""

    def __init__(self, name: str, clock: Callable[[], float] = time.monotonic) -> None:
        self.name = name
        self.clock = clock
        self.output = RateMeter(clock)
        self.latency = Samples()
        self.dropped = Counts()
        self.changed = threading.Event()
        self._started_s = clock()
        self._loop_s = clock()
        self._lock = threading.Lock()
        self._state = "unconfigured"
        self._ready = False
        self._waiting_for = ""
        self._error: RoboNeuronError | None = None
        self._error_count = 0
        self._values: dict[str, str] = {}
        self._work: dict[str, tuple[float, float]] = {}

    def set_state(self, state: str) -> None:
        """Lifecycle state's label; leaving "active" ends readiness."""
        with self._lock:
            self._state = state
            if state != "active":
                self._ready = False
        self.changed.set()

    def set_waiting(self, what: str) -> None:
        """Not ready: `what` is missing."""
        with self._lock:
            self._ready, self._waiting_for = False, what

    def set_ready(self) -> None:
        """The module has proved that it works."""
        with self._lock:
            if self._ready:
                return
            self._ready, self._waiting_for = True, ""
        self.changed.set()

    def set_error(self, error: RoboNeuronError) -> None:
        """Remember the newest failure; the same failure again is counted, not announced."""
        with self._lock:
            same = self._error is not None and str(self._error) == str(error)
            self._error, self._error_count = error, self._error_count + 1
        if not same:
            self.changed.set()

    def clear_error(self) -> None:
        """The module works again."""
        with self._lock:
            if self._error is None:
                return
            self._error = None
        self.changed.set()

    def set_value(self, key: str, value: str | float | int | bool) -> None:
        """Report one more value; numbers are written with six significant digits."""
        if isinstance(value, bool):
            text = "true" if value else "false"
        elif isinstance(value, float):
            text = f"{value:.6g}"
        else:
            text = str(value)
        with self._lock:
            self._values[key] = text

    def set_details(self, details: Mapping[str, str]) -> None:
        """Report texts under `detail.<key>`."""
        with self._lock:
            self._values.update({f"detail.{key}": text for key, text in details.items()})

    def tick_work(self, worker: str, limit_s: float) -> None:
        """A thread gets on; it is stalled when it does not say so again within `limit_s`."""
        with self._lock:
            self._work[worker] = (self.clock(), limit_s)

    def end_work(self, worker: str) -> None:
        """A thread has ended."""
        with self._lock:
            self._work.pop(worker, None)

    def tick_loop(self) -> None:
        """The executor turned."""
        self._loop_s = self.clock()

    def to_message(self) -> DiagnosticStatus:
        """The record as a DiagnosticStatus."""
        with self._lock:
            error = self._error
            values = {
                StatusKey.STATE: self._state,
                StatusKey.READY: "true" if self._ready else "false",
                StatusKey.WAITING_FOR: self._waiting_for,
                StatusKey.ERROR_CODE: error.code if error else "",
                StatusKey.ERROR: error.message if error else "",
                StatusKey.ERROR_HINT: error.hint if error else "",
                StatusKey.ERROR_COUNT: str(self._error_count),
                **self._values,
            }
            state = self._state
            work = list(self._work.values())
        now_s = self.clock()
        if work:
            ticked_s, limit_s = max(work, key=lambda tick: (now_s - tick[0]) / tick[1])
            values[StatusKey.WORK_AGE_S], values[StatusKey.WORK_LIMIT_S] = f"{now_s - ticked_s:.3f}", f"{limit_s:.3f}"
        values[StatusKey.UPTIME_S] = f"{now_s - self._started_s:.1f}"
        values[StatusKey.LOOP_AGE_S] = f"{now_s - self._loop_s:.3f}"
        values[StatusKey.RATE_HZ] = f"{self.output.rate_hz():.2f}"
        values[StatusKey.PUBLISHED] = str(self.output.total)
        values[StatusKey.DROPPED] = str(self.dropped.total())
        values.update({f"dropped.{name}": str(count) for name, count in self.dropped.items().items()})
        latency = self.latency.median_and_p99()
        if latency is not None:
            values[StatusKey.LATENCY_MS], values[StatusKey.LATENCY_P99_MS] = (f"{v:.3f}" for v in latency)
        return DiagnosticStatus(
            level=DiagnosticStatus.ERROR if error else DiagnosticStatus.OK,
            name=self.name,
            message=str(error) if error else state,
            hardware_id=str(os.getpid()),
            values=[KeyValue(key=key, value=text) for key, text in values.items()],
        )


class StatusReporter:
    """Publishes a ModuleStatus every STATUS_PERIOD_S, and at once after a change."""

    def __init__(self, node: Node, status: ModuleStatus) -> None:
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
