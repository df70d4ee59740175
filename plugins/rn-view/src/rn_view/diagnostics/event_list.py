"""Events for the list on the page: tool calls, faults, health changes, decisions of the gate."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from roboneuron import ForeignDataError, foreign
from roboneuron.feature import EndedCall, IncomingCall

_KEPT = 300
_MOST_TEXT = 300
_BAD_OUTCOMES = ("failed", "timed_out")
_FIRST_BYTES = 16_384
"""Bytes read from the end of an audit file at first."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ShownEvent:
    """One line of the list.

    Attributes:
        at_s: wall-clock time [s].
        what: "tool", "fault", "health", "gate" or "stop".
        text: what happened, as a sentence.
        is_bad: shown in red.
    """

    at_s: float
    what: str
    text: str
    is_bad: bool = False


class ShownEvents(Protocol):
    """Events as a page reads them."""

    @property
    def count(self) -> int:
        """Changes whenever the list changes."""
        ...

    def newest(self, most: int) -> list[ShownEvent]:
        """The newest events, newest first."""
        ...


class EventList:
    """The newest events; usable from any thread."""

    def __init__(self, clock: Callable[[], float] = time.time, kept: int | None = _KEPT) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._kept: deque[ShownEvent] = deque(maxlen=kept)
        self.count = 0
        """Number of events added so far."""

    def now_s(self) -> float:
        """Wall-clock time for a new event [s]."""
        return self._clock()

    def add(
        self,
        what: str,
        text: str,
        *,
        is_bad: bool = False,
        at_s: float | None = None,
        instead_of: ShownEvent | None = None,
    ) -> ShownEvent:
        """Add an event that happened now, or at `at_s`. It replaces `instead_of`, if that is still
        listed.
        """
        text = foreign.printable(text, _MOST_TEXT)
        at_s = self._clock() if at_s is None else at_s
        event = ShownEvent(at_s=at_s, what=what, text=text, is_bad=is_bad)
        with self._lock:
            if instead_of is not None and instead_of in self._kept:
                self._kept.remove(instead_of)
            self._kept.append(event)
            self.count += 1
        return event

    def remove(self, event: ShownEvent) -> None:
        """Remove an event, if it is still listed."""
        with self._lock:
            if event in self._kept:
                self._kept.remove(event)
                self.count += 1

    def newest(self, most: int) -> list[ShownEvent]:
        """The newest events, newest first."""
        with self._lock:
            return sorted(self._kept, key=lambda event: event.at_s, reverse=True)[:most]


class ToolCalls:
    """Adds an event when a tool call begins, and replaces it when the call has ended.

    Args:
        events: receives the events.
        is_quiet: whether only failures of a tool are added. For tools that only read, because
            agents call them often.
    """

    def __init__(
        self, events: EventList, is_quiet: Callable[[str], bool] = lambda tool: False
    ) -> None:
        self._events = events
        self._is_quiet = is_quiet
        self._begun: dict[int, ShownEvent] = {}

    def begun(self, call: IncomingCall) -> None:
        """Listener of `Events.call_begun`."""
        if not self._is_quiet(call.name):
            self._begun[id(call)] = self._events.add("tool", f"{_shown_call(call)} ...")

    def ended(self, ended: EndedCall) -> None:
        """Listener of `Events.call_ended`. Of a call with a verdict, such as `run_task`, it is
        listed as the client has got it.
        """
        begun = self._begun.pop(id(ended.call), None)
        structured = {} if ended.answer is None else ended.answer.structured
        outcome, reason = str(structured.get("outcome", "")), str(structured.get("reason", ""))
        is_bad = ended.error is not None or ended.outcome == "cancelled"
        if ended.outcome == "cancelled":
            said = "cancelled"
        elif ended.error is not None:
            said = str(ended.error)
        else:
            said = f"{outcome}: {reason}".rstrip(": ") if outcome else "done"
        if is_bad or not self._is_quiet(ended.call.name):
            self._events.add(
                "tool",
                f"{_shown_call(ended.call)}: {said}, {ended.took_s:.2f} s",
                is_bad=is_bad or outcome in _BAD_OUTCOMES,
                instead_of=begun,
            )


def _shown_call(call: IncomingCall) -> str:
    return f"{call.name}({shown_arguments(call.arguments)})"


def shown_arguments(arguments: object) -> str:
    """The arguments of a call as text for the list."""
    if not isinstance(arguments, dict) or not arguments:
        return ""
    return ", ".join(
        f"{key}={json.dumps(value, default=str)[:60]}" for key, value in list(arguments.items())[:8]
    )


class AuditReader:
    """Reads new records of an audit file that other processes write, also across a rotation. For
    one thread; keeps no file open.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rotated = path.with_name(f"{path.name}.1")
        self._inode = 0
        self._offset = 0
        self._rest = b""

    def read_new(self) -> list[dict[str, object]]:
        """Records written since the last call; the first call reads the end of the file. Empty when
        there is no file.
        """
        data = b""
        with contextlib.suppress(OSError):
            if self._inode and self._path.stat().st_ino != self._inode:
                if self._rotated.stat().st_ino == self._inode:
                    data = self._read(self._rotated)
                self._inode, self._offset = self._path.stat().st_ino, 0
            data += self._read(self._path)
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [record for line in lines if (record := _record(line)) is not None]

    def _read(self, path: Path) -> bytes:
        with path.open("rb") as file:
            found = os.fstat(file.fileno())
            if not self._inode:
                self._inode, self._offset = found.st_ino, max(0, found.st_size - _FIRST_BYTES)
            file.seek(self._offset)
            data = file.read()
            self._offset = file.tell()
            return data


def _record(line: bytes) -> dict[str, object] | None:
    """Parse a line; None for a truncated line and for anything else that is not an audit record."""
    try:
        record = foreign.decode_json(line, "a line of the audit")
    except ForeignDataError:
        return None
    return record if isinstance(record, dict) and "verdict" in record else None


def add_record(events: EventList, record: dict[str, Any]) -> None:
    """Add an audit record to the list."""
    parts = [
        str(record.get("verdict", "")),
        str(record.get("tool", "")),
        str(record.get("endpoint", "")),
    ]
    text = " ".join(part for part in parts if part)
    text += f", {record['who']}" if record.get("who") else ""
    text += f": {record['reason']}" if record.get("reason") else ""
    is_bad = record.get("verdict") in ("refused", "latched", "held", "lapsed")
    time_ns = record.get("time_ns", 0)
    at_s = time_ns / 1e9 if isinstance(time_ns, int | float) else 0.0
    events.add("gate", text, is_bad=is_bad, at_s=at_s)
