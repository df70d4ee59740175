"""Maintenance: a person takes the robot out of service. Nothing moves it until a person puts it
back, also after restarts.

The emergency stop is latched as long as it lasts, so that every module and the gate keep still; in
addition every tool that acts is refused, with the name of the person and the reason. Back in
service the stop is still latched: a person releases it as always, and nothing moves before a new
start.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from roboneuron import (
    CallContext,
    Feature,
    ForeignDataError,
    Host,
    RefusedError,
    StateError,
    Tool,
    foreign,
)
from roboneuron.feature import (
    AuditLog,
    AuditRecord,
    CallPhase,
    Interceptor,
    Periodic,
    Role,
    StillReason,
)

log = logging.getLogger(__name__)
NAME = "maintenance"
FILE_NAME = "maintenance.json"
_LOOK_S = 0.2
_MOST_TEXT = 300
_YEAR_9999_S = 253_370_764_800.0
"""A later time is no date for Python."""
_ALLOWED = ("take_over", "heartbeat", "label_recording", "stop_recording")
"""Tools that act on no robot."""


@dataclass(frozen=True, kw_only=True, slots=True)
class OutOfService:
    """Who took the robot out of service, why, and when [s, wall clock]."""

    who: str
    reason: str
    since_s: float

    def __str__(self) -> str:
        """A sentence for refusals and for the stop."""
        at = time.strftime("%Y-%m-%d %H:%M", time.localtime(self.since_s))
        who, reason = foreign.printable(self.who, 100), self.reason or "maintenance"
        return f"{who} took the robot out of service at {at}: {foreign.printable(reason)}"

    def still_reason(self) -> StillReason:
        """Why nothing moves the robot."""
        return StillReason(
            rank="service",
            rule=NAME,
            message=f"{self}.",
            hint="A person puts it back in service on the page or with `roboneuron robot "
            "maintenance --end`. Wait, or ask that person.",
        )


class MaintenanceFile:
    """The state on disk, shared by the server and the terminal.

    Args:
        directory: the state directory.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / FILE_NAME

    def read(self) -> OutOfService | None:
        """The present state; None in service. A file that cannot be read counts as out of
        service.
        """
        try:
            told = foreign.read_json(self.path)
            return OutOfService(
                who=foreign.text(foreign.field(told, "who"), "who", _MOST_TEXT),
                reason=foreign.text(foreign.field(told, "reason"), "reason", _MOST_TEXT),
                since_s=foreign.number(
                    foreign.field(told, "since_s"), "since_s", 0.0, _YEAR_9999_S
                ),
            )
        except FileNotFoundError:
            return None
        except ForeignDataError as error:
            reason = (
                f"{self.path} is damaged ({str(error)[:100]}); look at the robot, then end the "
                "maintenance, which removes the file"
            )
            return OutOfService(who="somebody", reason=reason, since_s=0.0)

    def begin(self, who: str, role: str, reason: str, audit: AuditLog) -> OutOfService:
        """Take the robot out of service; who did so first stays.

        Raises:
            RefusedError: the role is not an operator's, or the file cannot be written.
        """
        Role.OPERATOR.check(who, role, "Taking the robot out of service")
        found = self.read()
        if found is not None:
            return found
        state = OutOfService(
            who=foreign.encodable(who[:200]),
            reason=foreign.encodable(reason[:_MOST_TEXT]),
            since_s=time.time(),
        )
        audit.write_if_possible(_record(who, role, "begin_maintenance", reason))
        try:
            foreign.write_private(self.path, json.dumps(asdict(state)))
        except OSError as error:
            raise RefusedError(
                f"{self.path} cannot be written: {error.strerror}; the robot is in service.",
                hint="Press the emergency stop, and mend the state directory.",
                rule="audit",
            ) from error
        return state

    def end(self, who: str, role: str, audit: AuditLog) -> OutOfService | None:
        """Put the robot back in service; returns the state before. The emergency stop stays
        latched.

        Raises:
            RefusedError: the role is not an admin's, or the audit cannot be written.
            StateError: the file cannot be removed; the robot stays out of service.
        """
        Role.ADMIN.check(who, role, "Putting the robot back in service")
        found = self.read()
        if found is None:
            return None
        audit.write(_record(who, role, "end_maintenance", str(found)))
        try:
            self.path.unlink(missing_ok=True)
        except OSError as error:
            raise StateError(
                f"{self.path} cannot be removed: {error.strerror}; the robot stays out of service."
            ) from error
        return found


class MaintenanceFeature(Feature[None]):
    """Refuses everything that acts while the robot is out of service, and keeps the stop
    latched.

    There is no tool for it: an agent can neither begin nor end it. People use the page or
    `roboneuron robot maintenance`.
    """

    _watch: Periodic | None = None

    def tools(self, host: Host) -> Sequence[Tool]:
        """See `Feature.tools`: none."""
        self._host = host
        self._file = MaintenanceFile(host.state_directory)
        # file and state change together, so that no call is admitted by an outdated state
        self._lock = threading.Lock()
        self._state = self._file.read()
        return ()

    def interceptors(self, host: Host) -> Sequence[Interceptor]:
        """See `Feature.interceptors`."""
        return [Interceptor(name=NAME, phase=CallPhase.PERMISSION, check=self.admit)]

    def start(self, host: Host) -> None:
        """Watch the file, which a terminal may write."""
        self._watch = Periodic(NAME, _LOOK_S, self.look)
        self._watch.start()

    def close(self) -> None:
        """Stop watching; idempotent."""
        if self._watch is not None:
            self._watch.close()

    @property
    def state(self) -> OutOfService | None:
        """Who took the robot out of service; None in service."""
        return self._state

    def admit(self, tool: Tool[Any], context: CallContext) -> None:
        """Check one call. Raises RefusedError out of service, but for tools that read or stop."""
        state = self._state
        if state is None or tool.read_only or tool.always or tool.name in _ALLOWED:
            return
        raise state.still_reason().refusal()

    def still_reasons(self, asker: CallContext | None) -> Sequence[StillReason]:
        """See `Feature.still_reasons`."""
        state = self._state
        return () if state is None else (state.still_reason(),)

    def begin(self, who: str, role: str, reason: str) -> OutOfService:
        """Take the robot out of service; returns once the stop is confirmed.

        Raises:
            RefusedError: as `MaintenanceFile.begin`.
            UnsafeError: a module did not confirm the stop; the robot is out of service
                nevertheless.
        """
        with self._lock:
            self._state = self._file.begin(who, role, reason, self._host.audit)
        self._latch(self._state)
        return self._state

    def end(self, who: str, role: str) -> None:
        """Put it back in service. Raises as `MaintenanceFile.end`."""
        with self._lock:
            self._file.end(who, role, self._host.audit)
            self._state = None

    def look(self) -> None:
        """Follow the file; latch a stop that was released meanwhile."""
        with self._lock:
            state = self._state = self._file.read()
        if state is not None and not self._host.loop.emergency_stop.is_latched():
            self._latch(state)

    def _latch(self, state: OutOfService) -> None:
        stop = self._host.loop.emergency_stop
        if not stop.is_latched():
            namespace = self._host.config.namespace
            stop.latch(namespace, who=state.who, reason=f"maintenance: {state.reason}")


def _record(who: str, role: str, tool: str, reason: str) -> AuditRecord:
    return AuditRecord(who=who, role=role, tool=tool, verdict="allowed", reason=reason)
