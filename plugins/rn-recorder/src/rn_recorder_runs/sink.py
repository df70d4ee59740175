"""Consecutive files for messages; if the disk cannot be written, only messages are lost."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from rn_recorder_runs.files import FLUSH_S, LATCHED, Record, RunFile

log = logging.getLogger(__name__)
RETRY_S = 2.0
_MOST_LATCHED = 8
"""Messages kept per latched topic: several nodes may publish on /tf_static."""


class Latched:
    """Data required by every file: metadata of topics, and the newest messages of latched ones.

    Attributes:
        channels: metadata by topic.
        definitions: definition by type, for types that are not installed.
    """

    def __init__(self) -> None:
        self.channels: dict[str, dict[str, str]] = {}
        self.definitions: dict[str, str] = {}
        self._held: dict[tuple[str, bytes], Record] = {}

    def note(self, record: Record) -> None:
        """Store a message if its topic is latched: equal messages once, at most a few per topic."""
        if LATCHED not in self.channels.get(record.topic, {}):
            return
        self._held.pop((record.topic, record.data), None)
        self._held[record.topic, record.data] = record
        own = [key for key in self._held if key[0] == record.topic]
        for key in own[:-_MOST_LATCHED]:
            del self._held[key]

    def records(self, before_ns: int) -> list[Record]:
        """The newest messages before that time [ns], stamped with that time, so that they do not
        extend a file's span.
        """
        return [
            replace(record, log_ns=before_ns)
            for record in self._held.values()
            if record.log_ns < before_ns
        ]


class Sink:
    """One file is open at a time; `finish` ends it, and the next message begins another.

    Attributes:
        lost: messages that could not be written.
        problem: reason why nothing is written now; empty for none.
    """

    def __init__(
        self,
        name: str,
        next_path: Callable[[], Path],
        about: Mapping[str, str],
        latched: Latched | None = None,
    ) -> None:
        self.name = name
        self._latched = latched or Latched()
        self.file: RunFile | None = None
        self.lost = 0
        self.problem = ""
        self._next_path = next_path
        self._about = about
        self._flushed_s = 0.0
        self._retry_s = 0.0

    def write(self, record: Record, now_s: float) -> None:
        if self.problem and now_s < self._retry_s:
            self.lost += 1
            return
        try:
            if self.file is None:
                path = self._next_path()
                path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
                about = {**self._about, "begun_ns": str(record.log_ns)}
                self.file = RunFile(path, about, self._latched.definitions, self._latched.channels)
                self._flushed_s = now_s
                for held in self._latched.records(record.log_ns):
                    self.file.write(held)
            self.problem = ""
            self.file.write(record)
            self.flush(now_s)
        except OSError as error:
            self.lost += 1
            self.fail(error, now_s)

    def flush(self, now_s: float) -> None:
        """Write buffered messages, if due."""
        if self.file is None or now_s - self._flushed_s < FLUSH_S:
            return
        self._flushed_s = now_s
        try:
            self.file.flush()
        except OSError as error:
            self.fail(error, now_s)

    def fail(self, error: OSError, now_s: float) -> None:
        reason = error.strerror or str(error)
        if reason != self.problem:
            log.error(
                "The %s cannot be written: %s; tried again every %g s.", self.name, reason, RETRY_S
            )
        self.problem, self._retry_s = reason, now_s + RETRY_S
        if self.file is not None:
            self.lost += self.file.unwritten
            self.file.abandon()
            if self.file.messages == self.file.unwritten:  # none of them can be read
                with suppress(OSError):
                    self.file.path.unlink()
            self.file = None

    def finish(self) -> Path | None:
        """Close the open file; returns its path."""
        file, self.file = self.file, None
        if file is None:
            return None
        try:
            file.finish()
        except OSError as error:
            self.file = file
            self.fail(error, time.monotonic())
        return file.path
