"""Alarms, kept until a person acknowledges them, also across restarts of the server.

Source of the terms (alarm, acknowledge, return to normal): ISA-18.2 / IEC 62682.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from roboneuron import (
    ForeignDataError,
    InvalidInputError,
    foreign,
)
from roboneuron.feature import AuditLog, AuditRecord

log = logging.getLogger(__name__)
FILE_NAME = "alarms.json"
KEPT = 200
"""Maximum number. Beyond it the oldest acknowledged alarm is deleted, or else the oldest."""
_MOST_TEXT = 300
_MOST_BYTES = 1 << 22


@dataclass(frozen=True, kw_only=True, slots=True)
class Alarm:
    """One alarm. It counts repeated occurrences until it is acknowledged.

    Attributes:
        number: unique; increases.
        source: module, or "emergency stop", "server".
        what: its kind, such as "silent" or "limit: zone".
        cause: what happened, as a sentence.
        advice: what a person can do.
        is_warning: nothing has stopped; shown less prominently.
        first_s, last_s: wall-clock times of the first and the newest occurrence [s].
        count: number of occurrences.
        over_s: when it returned to normal [s]; 0 while it lasts, and for momentary events.
        acknowledged_by, acknowledged_s: who acknowledged it, and when [s]; empty and 0 before.
    """

    number: int
    source: str
    what: str
    cause: str
    advice: str
    first_s: float
    last_s: float
    is_warning: bool = False
    count: int = 1
    over_s: float = 0.0
    acknowledged_by: str = ""
    acknowledged_s: float = 0.0

    @property
    def is_open(self) -> bool:
        """Whether it has not been acknowledged yet."""
        return not self.acknowledged_by


class AlarmBook:
    """The alarms of one robot; usable from any thread.

    Args:
        directory: state directory, which holds `alarms.json`.
        audit: gets a record of each acknowledgement.
        clock: wall clock [s].
        kept: maximum number of alarms.
    """

    def __init__(
        self,
        directory: Path,
        audit: AuditLog,
        clock: Callable[[], float] = time.time,
        kept: int = KEPT,
    ) -> None:
        self._path = directory / FILE_NAME
        self._audit, self._clock, self._kept = audit, clock, kept
        self._lock = threading.Lock()
        self._is_changed = False
        self._failure = ""
        self.seen_ns = 0
        """Time of the newest audit record handled [ns]. Older records raise no alarm again."""
        self.alarms: dict[int, Alarm] = {}
        """By number, oldest first."""
        self._read()

    def add(
        self,
        source: str,
        what: str,
        cause: str,
        advice: str,
        *,
        is_warning: bool = False,
        at_s: float | None = None,
    ) -> Alarm:
        """Raise an alarm. If an open one has the same source and kind, count it there instead."""
        at_s = self._clock() if at_s is None else at_s
        cause = foreign.printable(cause, _MOST_TEXT)
        with self._lock:
            self._is_changed = True
            same = self._open_one(source, what)
            if same is not None:
                last_s = max(same.last_s, at_s)
                again = replace(same, cause=cause, last_s=last_s, count=same.count + 1, over_s=0.0)
                self.alarms[same.number] = again
                return again
            alarm = Alarm(
                number=max(self.alarms, default=0) + 1,
                source=source,
                what=what,
                cause=cause,
                advice=advice,
                is_warning=is_warning,
                first_s=at_s,
                last_s=at_s,
            )
            self.alarms[alarm.number] = alarm
            if len(self.alarms) > self._kept:
                acknowledged = (one.number for one in self.alarms.values() if not one.is_open)
                del self.alarms[next(acknowledged, next(iter(self.alarms)))]
            return alarm

    def end(self, source: str, at_s: float | None = None) -> None:
        """Mark the alarms of a source as returned to normal. They stay until they are
        acknowledged.
        """
        at_s = self._clock() if at_s is None else at_s
        with self._lock:
            for alarm in self.alarms.values():
                if alarm.source == source and not alarm.over_s and at_s >= alarm.last_s:
                    self.alarms[alarm.number] = replace(alarm, over_s=at_s)
                    self._is_changed = True

    def acknowledge(self, number: int, who: str, role: str) -> Alarm:
        """Acknowledge an alarm for a person; idempotent.

        Raises:
            InvalidInputError: there is no such alarm.
            RefusedError: the audit cannot be written.
        """
        with self._lock:
            alarm = self.alarms.get(number)
        if alarm is None:
            raise InvalidInputError(
                f"There is no alarm {number}.", hint="Reload the page.", path="alarm"
            )
        if not alarm.is_open:
            return alarm
        self._audit.write(
            AuditRecord(
                who=who,
                role=role,
                tool="acknowledge_alarm",
                verdict="allowed",
                reason=f"{alarm.source}: {alarm.what}: {alarm.cause}",
                arguments={"alarm": number, "count": alarm.count, "first_s": alarm.first_s},
            )
        )
        with self._lock:
            alarm = self.alarms.get(number, alarm)
            seen = replace(alarm, acknowledged_by=who, acknowledged_s=self._clock())
            self.alarms[number] = seen
            self._is_changed = True
        self.save()
        return seen

    def newest(self) -> list[Alarm]:
        """All alarms: open ones first, then the acknowledged ones; each newest first."""
        with self._lock:
            found = list(self.alarms.values())
        return sorted(found, key=lambda alarm: (alarm.is_open, alarm.last_s), reverse=True)

    def save(self) -> None:
        """Write changes to the file. A failure is only logged, once, because it must not stop the
        code that raises alarms.
        """
        with self._lock:
            if not self._is_changed:
                return
            self._is_changed = False
            told = {
                "seen_ns": self.seen_ns,
                "alarms": [asdict(alarm) for alarm in self.alarms.values()],
            }
        failure = ""
        try:
            foreign.write_private(self._path, json.dumps(told))
        except OSError as error:
            failure = f"Cannot write the alarms to {self._path}: {error.strerror or error}"
            with self._lock:
                self._is_changed = True
        if failure and failure != self._failure:
            log.error("%s", failure)
        self._failure = failure

    def _open_one(self, source: str, what: str) -> Alarm | None:
        same = (
            alarm
            for alarm in reversed(self.alarms.values())
            if alarm.is_open and (alarm.source, alarm.what) == (source, what)
        )
        return next(same, None)

    def _read(self) -> None:
        try:
            told = foreign.read_json(self._path, most_bytes=_MOST_BYTES)
            listed = foreign.items(foreign.field(told, "alarms"), "alarms", most=100_000)
            found = [foreign.to_dataclass(Alarm, one, "an alarm") for one in listed[-self._kept :]]
            self.seen_ns = foreign.integer(foreign.field(told, "seen_ns"), "seen_ns")
        except FileNotFoundError:
            return
        except ForeignDataError as error:
            log.error(
                "Cannot read the alarms in %s; starting with an empty list: %s", self._path, error
            )
            self.add(
                "server",
                "alarms lost",
                f"{self._path.name} could not be read: {error}",
                "Earlier alarms are in the audit: roboneuron logs.",
            )
            return
        self.alarms = {alarm.number: alarm for alarm in found}
