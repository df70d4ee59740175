"""The recorder's process: `python -m rn_recorder_runs.node`, started by the feature; settings and
orders arrive on stdin.

It has three threads: one receives serialized messages from ROS into a bounded queue; one reads
stdin; one encodes and writes messages at once, so that the work is done between two images. It is a
separate process and publishes nothing, so its failures do not affect other processes.
"""

from __future__ import annotations

import json
import logging
import math
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from rn_recorder_runs.audit_tail import AuditTail
from rn_recorder_runs.files import Record
from rn_recorder_runs.frames import Frames
from rn_recorder_runs.images import COMPRESSED, IMAGE, to_jpeg, to_string
from rn_recorder_runs.line_pipe import LinePipe, own_stdout, parse_line
from rn_recorder_runs.priority import give_way
from rn_recorder_runs.recording import Recording, Rules
from rn_recorder_runs.settings import RecorderSettings
from rn_recorder_runs.store import RunStore
from roboneuron import RoboNeuronError, StateError
from roboneuron.command import HangWatch, Signals, discover, environment
from roboneuron.feature import AuditLog, log_files

log = logging.getLogger("recorder")
EVENTS_TOPIC, AUDIT_TOPIC = "/roboneuron/events", "/roboneuron/audit"
STRING = "std_msgs/msg/String"
MOST_BYTES = 128_000_000
"""Maximum size of messages that wait to be encoded and written."""
_TURN_S, _STATUS_S = 0.1, 0.5
"""Duration of a cycle without messages; the tap's own cycles are shorter, and each starts
one here.
"""
_PREDECESSOR_S = 15.0
_LEAVE_S = 5.0
"""Longest time for leaving ROS."""
_LATCHED = "latched"


class Backlog:
    """Message queue between the threads; messages that do not fit are dropped and counted."""

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self._records: deque[Record] = deque()
        self._lock = threading.Lock()
        self._bytes = 0
        self._most_bytes = most_bytes
        self.dropped = 0

    def put(self, record: Record) -> None:
        """Add one message; never blocks."""
        with self._lock:
            if self._bytes + len(record.data) > self._most_bytes:
                self.dropped += 1
                return
            self._bytes += len(record.data)
            self._records.append(record)

    def get(self) -> Record | None:
        """Take the oldest message."""
        with self._lock:
            if not self._records:
                return None
            record = self._records.popleft()
            self._bytes -= len(record.data)
            return record


class RecorderWorker:
    """All work except ROS: orders, encoding, writing, status.

    Args:
        settings: its settings.
        tell: writes one line to the server, without blocking.
    """

    def __init__(
        self, settings: RecorderSettings, tell: Callable[[Mapping[str, object]], object]
    ) -> None:
        self._settings = settings
        self._tell = tell
        self._backlog = Backlog()
        self._orders: deque[dict[str, object]] = deque()
        self._stop = threading.Event()
        self.wake = threading.Event()
        """Set when messages were added."""
        self._was_dismissed = False
        self._holds_directory = False
        self._undecodable = 0
        self._missed_before = 0
        self._events = 0
        self._audit = AuditTail(AuditLog.in_directory(settings.state_directory).path)
        self.recording = Recording(
            RunStore(settings.directory), Rules(**settings.rules.model_dump()), settings.about
        )
        self._frames = Frames(settings, self.recording)
        self.counts: Callable[[], dict[str, Any]] = dict
        self._parent = os.getppid()
        self.put = self._backlog.put

    def begin(self) -> None:
        """Adopt the existing files; a directory that cannot be written is tried again with each
        message.

        Raises:
            StateError: another recorder uses the directory and does not end.
        """
        try:
            self.recording.store.make()
            self._hold()
            self.recording.adopt()
            self._frames.begin()
        except (OSError, ValueError, KeyError) as error:
            log.error("%s cannot be used now: %s", self._settings.directory, error)
        if self._settings.resume:
            with suppress(RoboNeuronError):
                self.recording.start(self._settings.resume_name, {}, resumed=self._settings.resume)
        threading.Thread(target=self._listen, name="orders", daemon=True).start()

    def _hold(self) -> None:
        """Lock the directory for the life of this process; a recorder that is just ending finishes
        its files first.
        """
        until_s = time.monotonic() + _PREDECESSOR_S
        while self.recording.store.lock() is None:
            if time.monotonic() > until_s:
                raise StateError(f"Another recorder works in {self._settings.directory}.")
            time.sleep(_TURN_S)
        self._holds_directory = True

    def run(self, signals: Signals) -> None:
        """Encode and write until the server ends or requests the end."""
        told_s = 0.0
        while not (signals.is_leaving or self._stop.is_set()):
            self._turn()
            if time.monotonic() - told_s > _STATUS_S:
                told_s = time.monotonic()
                if not self._holds_directory:
                    with suppress(OSError):  # it still cannot be written
                        self._holds_directory = self.recording.store.lock() is not None
                self._tell({"status": self._status()})
            self.wake.wait(_TURN_S)
            self.wake.clear()
        self._turn()
        if not self._was_dismissed and (os.getppid() != self._parent or not signals.is_leaving):
            self.recording.incident(
                "server_ended", {"explanation": "The server ended without taking leave."}
            )
        self.recording.close("finished" if self._was_dismissed else "interrupted")
        self._audit.close()

    def _turn(self) -> None:
        for line, entry in self._audit.lines():
            self.recording.take(
                _string(AUDIT_TOPIC, line, int(entry.get("time_ns") or time.time_ns()))
            )
            if entry.get("verdict") == _LATCHED:
                self.recording.incident("emergency_stop", {"audit": entry})
        until_s = time.monotonic() + _STATUS_S
        while (record := self._backlog.get()) is not None and time.monotonic() < until_s:
            self._write(record)
        if record is not None:
            self._write(record)
        while self._orders:  # a recording that ends now includes earlier messages
            self._obey(self._orders.popleft())
        self.recording.tick()

    def describe(self, topic: str, metadata: Mapping[str, str]) -> None:
        """Store a topic's metadata for later files; its images may be recorded under
        another name.
        """
        channels = self.recording.latched.channels
        for name in (topic, f"{topic}/compressed"):
            if channels.get(name) != metadata:
                channels[name] = dict(metadata)

    def _write(self, record: Record) -> None:
        if record.type == IMAGE and self._settings.images == "jpeg":
            try:
                encoded = to_jpeg(record.data, self._settings.jpeg_quality)
            except ValueError:
                self._undecodable += 1
                return
            if encoded is not None:
                topic = f"{record.topic}/compressed"
                record = Record(
                    topic, COMPRESSED, record.log_ns, record.publish_ns, record.sequence, encoded
                )
        self._frames.follow(record)
        self.recording.take(record)

    def _obey(self, order: Mapping[str, Any]) -> None:
        what = order.get("do")
        if what == "event":
            self._note(order)
            return
        answer: dict[str, Any] = {"re": order.get("number")}
        try:
            self._check(order)
            if what == "start":
                answer["id"] = self.recording.start(str(order["name"]), dict(order["facts"]))
                self._missed_before = self._missed()
            elif what == "stop":
                missed = self._missed() - self._missed_before
                answer |= {"run": self.recording.stop({**dict(order["facts"]), "missed": missed})}
        except RoboNeuronError as error:
            answer |= {"error": error.message, "hint": error.hint}
        self._tell(answer)

    def _check(self, order: Mapping[str, Any]) -> None:
        """Refuse an order whose caller has given up, or for another recording. Raises
        StateError.
        """
        if time.monotonic() > float(order.get("until_s", math.inf)):
            raise StateError("The order came too late; nothing was done.", hint="Call again.")
        run = order.get("run", "")
        if run and run != self.recording.active_id:
            raise StateError(f"The recording {run} is not in progress.")

    def _missed(self) -> int:
        """Number of messages that came too fast for this process, since its start."""
        gaps: Mapping[str, int] = self.counts().get("gaps", {})
        return self._backlog.dropped + sum(gaps.values())

    def _note(self, order: Mapping[str, Any]) -> None:
        self._events += 1
        fact = {"what": order["what"], "at_ns": order["at_ns"], **dict(order["facts"])}
        self.recording.take(
            _string(EVENTS_TOPIC, json.dumps(fact), int(order["at_ns"]), self._events)
        )
        if order.get("incident"):
            self.recording.incident(str(order["incident"]), fact)

    def _status(self) -> dict[str, object]:
        usage = os.times()
        return {
            **self.recording.state(),
            **self.counts(),
            "dropped": self._backlog.dropped,
            "undecodable": self._undecodable,
            "cpu_s": round(usage.user + usage.system, 3),
            "incidents": list(self.recording.incidents_written[-20:]),
        }

    def _listen(self) -> None:
        with os.fdopen(os.dup(0), "rb") as stream:
            for line in stream:
                order = parse_line(line)
                if order is None:
                    log.error("The server sent a line that is no order: %.200r", line)
                elif order.get("do") == "leave":
                    self._was_dismissed = True
                    break
                else:
                    self._orders.append(order)
        self._stop.set()
        self.wake.set()


def _string(topic: str, text: str, at_ns: int, sequence: int = 0) -> Record:
    return Record(topic, STRING, time.time_ns(), at_ns, sequence, to_string(text))


def _absolute(patterns: tuple[str, ...], namespace: str) -> list[str]:
    return [
        pattern if pattern.startswith("/") else f"/{namespace}/{pattern}" for pattern in patterns
    ]


def main() -> None:
    """Entry point."""
    log_files.begin_logging(logging.INFO)
    watch = HangWatch()
    watch.start()
    pipe = LinePipe(own_stdout())
    first = b""
    while not first.endswith(b"\n"):
        byte = os.read(0, 1)
        if not byte:
            sys.exit("stdin ended before the settings came.")
        first += byte
    settings = RecorderSettings.model_validate_json(first)
    give_way()
    signals = Signals()
    signals.listen()
    environment.prepare_environment(settings.state_directory / "log" / "ros")
    discover()  # because features may provide message types
    with watch.loading():
        import rclpy  # heavy
        from rclpy.node import Node
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions

        from rn_recorder_runs.tap import TopicTap

    process = RecorderWorker(settings, pipe.write)
    try:
        process.begin()
    except StateError as error:
        sys.exit(str(error))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    nothing_served = [Parameter("start_type_description_service", value=False)]
    with watch.loading():  # joining the graph keeps the interpreter's lock
        node = Node(
            f"recorder_{os.getpid()}",
            enable_rosout=False,
            start_parameter_services=False,
            parameter_overrides=nothing_served,
        )
    topics = _absolute(settings.topics, settings.namespace)
    tap = TopicTap(
        node, topics, _absolute(settings.exclude, settings.namespace), process.put, process.describe
    )
    process.counts = lambda: {"received": dict(tap.received), "gaps": dict(tap.gaps)}
    leaving = threading.Event()

    def take() -> None:
        try:
            tap.run(leaving, process.wake.set)
        except Exception:
            log.exception("Nothing is heard any more; the server starts another recorder.")
            signals.leave()

    taking = threading.Thread(target=take, name="ros", daemon=True)
    taking.start()
    try:
        process.run(signals)  # on the main thread, which handles signals
    finally:
        # The files are closed. destroy_node has been observed to hang: a sender to a process that
        # was killed while receiving a message may block for ever (Fast DDS 2.14, issue 6484).
        # SIGALRM then ends the process.
        signal.setitimer(signal.ITIMER_REAL, _LEAVE_S)
        leaving.set()
        taking.join()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
