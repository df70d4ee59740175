"""Tools for reading the modules' logs and the incident records."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from rn_standard.ops.incidents import KEPT, FaultSpans, Incidents
from rn_standard.ops.server_log import FILE_NAME
from roboneuron import Arguments, CallContext, InvalidInputError, Resource, Result, Tool
from roboneuron.feature import Modules, log_files

Level = Literal["debug", "info", "warning", "error"]
SERVER = "server"
"""In place of a module: the server itself."""
_LEVELS: tuple[Level, ...] = ("debug", "info", "warning", "error")
_RANK = {"DEBUG": 0, "INFO": 1, "WARNING": 2, "ERROR": 3, "CRITICAL": 3}
_ENTRY = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3}) (\w+) ([\w.\-]+): (.*)")
LOG_LINES = 500
_MOST_LINES = 2000
_MOST_TEXT = 4000
_MOST_LOG, _MOST_ANSWER = 8000, 20_000
"""Maximum characters of the log in one record, and of all entries of get_logs together."""
_MOST_RESOURCE = 40_000
_LINE = 200


Severity = Literal["low", "medium", "high"]
_ORDER: tuple[Severity, ...] = ("high", "medium", "low")
_SEVERITIES: Mapping[str, Severity] = {
    **dict.fromkeys(("exited", "stuck", "silent", "latch_vanished"), "high"),
    "stalled": "low",
}
"""Severity by the word of a fault; the others are medium."""
_PASSES_S: Mapping[str, float] = {"stuck": 1.0, "silent": 1.0}
"""Duration [s] below which such a fault was only late: an overloaded computer has dozens of them,
and watchdogs have acted where it mattered.
"""


class GetLogs(Arguments):
    """Arguments of get_logs."""

    module: str = Field(
        description="robot, perception, inference, control ...; server: the server's own log."
    )
    entries: int = Field(default=50, ge=1, le=500, description="Maximum number; the newest.")
    level: Level = Field(default="debug", description="Minimum level.")
    contains: str = Field(default="", max_length=200, description="Only entries with this text.")


class LogEntry(Result):
    """One entry; `level` is empty for text not written by the logger (a plugin's or library's own
    output).
    """

    at: str = Field(default="", description="local time")
    level: str = ""
    logger: str = ""
    text: str


class LogsResult(Result):
    """The newest entries, oldest first."""

    module: str
    entries: list[LogEntry]
    more: int = Field(
        description="older entries of the end of the log that are left out; `contains` and "
        "`level` narrow it"
    )
    path: str = Field(description="the whole log, on the server's host")


class ListIncidents(Arguments):
    """Arguments of list_incidents."""

    entries: int = Field(default=10, ge=1, le=100, description="Maximum number; the newest.")
    module: str | None = Field(default=None, description="Only of this module.")
    id: str | None = Field(
        default=None, max_length=200, description="Only this one, with status, log and actions."
    )
    all_robots: bool = Field(default=False, description="Of other robots too.")


class Incident(Result):
    """One fault in a line; the second part only for the one whose id was given."""

    id: str
    at: str = Field(description="ISO 8601")
    module: str
    what: str = Field(description="failing, stalled, stuck, silent, exited, restart ...")
    explanation: str = Field(
        default="", description="what that means, and the module's error if it had one"
    )
    before: str = Field(default="", description="previous health")
    status: dict[str, object] = Field(
        default_factory=dict, description="the module's last status, as in get_status"
    )
    log: list[str] = Field(default_factory=list, description="the end of its log")
    actions: list[dict[str, object]] = Field(
        default_factory=list,
        description="the last actions on the action topic: when they were sent, and their values",
    )


class IncidentKind(Result):
    """Incidents of one kind of one module."""

    sparse = True

    module: str
    what: str
    severity: Severity = Field(description="high: the module did not work; low: it was late")
    count: int
    first: str = Field(description="ISO 8601")
    last: str
    now: bool = Field(description="it is so now")
    longest_s: float | None = Field(default=None, description="longest, while this server ran")


class IncidentsResult(Result):
    """What went wrong by kind, worst first; and the newest records, newest first."""

    sparse = True

    kinds: list[IncidentKind] = Field(default_factory=list)
    incidents: list[Incident]
    more: int = Field(description="further records that fit the call")
    since: str = Field(default="", description="older records are removed; counts begin then")
    directory: str = Field(description="where the whole records are, on the server's host")


def incident_line(record: Mapping[str, Any]) -> Incident:
    """Convert a record to one line."""
    told = str(record.get("explanation", ""))
    error = (record.get("status") or {}).get("error") or {}
    if error.get("message"):
        told = f"{told}: {error['message']}" if told else str(error["message"])
    return Incident(
        id=str(record.get("id", "")),
        at=str(record.get("at", "")),
        module=str(record.get("module", "")),
        what=str(record.get("what", "")),
        explanation=told if len(told) <= _LINE else f"{told[:_LINE]} ...",
    )


def incident_kinds(records: Sequence[Mapping[str, Any]], spans: FaultSpans) -> list[IncidentKind]:
    """Records (newest first) by module and kind; the worst kinds first."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for record in records:
        key = str(record.get("module", "")), str(record.get("what", ""))
        grouped.setdefault(key, []).append(str(record.get("at", "")))
    kinds = [
        IncidentKind(
            module=module,
            what=what,
            severity=_severity(what, longest_s, spans.is_now(module, what)),
            count=len(times),
            first=times[-1],
            last=times[0],
            now=spans.is_now(module, what),
            longest_s=None if longest_s is None else round(longest_s, 1),
        )
        for (module, what), times in grouped.items()
        for longest_s in (spans.longest_s(module, what),)
    ]
    return sorted(kinds, key=lambda kind: (not kind.now, _ORDER.index(kind.severity), -kind.count))


def _severity(what: str, longest_s: float | None, is_now: bool) -> Severity:
    if not is_now and longest_s is not None and longest_s < _PASSES_S.get(what, 0.0):
        return "low"
    return _SEVERITIES.get(what, "medium")


def whole_incident(record: Mapping[str, Any]) -> Incident:
    """All stored data of a fault, without empty fields; a long log is truncated at its
    beginning.
    """
    parts = _filled({key: record[key] for key in Incident.model_fields if key in record})
    if "log" in parts:
        parts["log"] = newest_lines(parts["log"], _MOST_LOG)
    if "status" in parts:
        parts["status"] = _filled(parts["status"])
    return Incident.model_validate(parts)


def _filled(facts: Mapping[str, object]) -> dict[str, Any]:
    return {key: value for key, value in facts.items() if value not in (None, "", [], {})}


def newest_lines(lines: Sequence[str], most: int) -> list[str]:
    """The last lines within a maximum of characters; states the number of omitted lines."""
    kept: list[str] = []
    for line in reversed(lines):
        most -= len(line)
        if most < 0:
            return [f"({len(lines) - len(kept)} older lines are left out)", *reversed(kept)]
        kept.append(line)
    return kept[::-1]


def newest_entries(entries: Sequence[LogEntry]) -> list[LogEntry]:
    """The last entries, at least one, within the maximum length of an answer."""
    kept: list[LogEntry] = []
    room = _MOST_ANSWER
    for entry in reversed(entries):
        room -= len(entry.text) + len(entry.logger)
        if kept and room < 0:
            break
        kept.append(entry)
    return kept[::-1]


def parse_entries(lines: tuple[str, ...]) -> list[LogEntry]:
    """Parse log lines to entries; continuation lines (a traceback) belong to the previous one."""
    entries: list[LogEntry] = []
    for line in lines:
        match = _ENTRY.match(line)
        if match:
            at, level, logger, text = match.groups()
            entries.append(LogEntry(at=at, level=level.lower(), logger=logger, text=text))
        elif entries and entries[-1].level:
            text = f"{entries[-1].text}\n{line}"[:_MOST_TEXT]
            entries[-1] = entries[-1].model_copy(update={"text": text})
        else:
            entries.append(LogEntry(text=line[:_MOST_TEXT]))
    return entries


def log_file(modules: Modules, source: str) -> Path:
    """Log file of a module or of the server; for a module without a process, its future one.

    Args:
        source: `SERVER`, or a module; one that has replaced another may log under the other of its
            two names.

    Raises:
        InvalidInputError: there is no such module.
    """
    if source == SERVER:
        return modules.log_directory / FILE_NAME
    _check(modules, source)
    settings = modules.slot(source).settings
    name = settings.node_name if settings is not None else source
    return modules.log_directory / f"{name}.log"


def _check(modules: Modules, name: str) -> None:
    if name not in modules.slots:
        raise InvalidInputError(
            f"There is no module {name[:80]!r}.",
            hint=f"Modules: {', '.join(modules.slots)}.",
            path="module",
        )


def log_resource(modules: Modules, source: str) -> Resource:
    """Create the resource with the end of a module's log, or of the server's."""
    return Resource(
        uri=f"roboneuron://logs/{source}",
        name=f"log of {source}",
        title=f"Log of {source}",
        description=f"The last {LOG_LINES} lines that {source} has written.",
        read=lambda: "\n".join(
            newest_lines(
                log_files.read_tail(log_file(modules, source), lines=LOG_LINES), _MOST_RESOURCE
            )
        ),
    )


def record_tools(modules: Modules, incidents: Incidents) -> list[Tool]:
    """Create get_logs and list_incidents."""

    async def get_logs(arguments: GetLogs, context: CallContext) -> LogsResult:
        path = log_file(modules, arguments.module)
        least = _LEVELS.index(arguments.level)
        entries = [
            entry
            for entry in parse_entries(
                await context.run(lambda _: log_files.read_tail(path, lines=_MOST_LINES))
            )
            if _RANK.get(entry.level.upper(), 1) >= least and arguments.contains in entry.text
        ]
        kept = newest_entries(entries[-arguments.entries :])
        return LogsResult(
            module=arguments.module, entries=kept, more=len(entries) - len(kept), path=str(path)
        )

    async def list_incidents(arguments: ListIncidents, context: CallContext) -> IncidentsResult:
        if arguments.module is not None:
            _check(modules, arguments.module)
        found = await context.run(lambda _: incidents.listing(KEPT))
        directory, robot = str(incidents.directory), incidents.robot()
        if arguments.id is not None:
            one = next((record for record in found if record.get("id") == arguments.id), None)
            if one is None:
                raise InvalidInputError(
                    f"There is no incident {arguments.id!r}.",
                    hint="Call list_incidents without `id`.",
                    path="id",
                )
            return IncidentsResult(incidents=[whole_incident(one)], more=0, directory=directory)
        fitting = [
            record
            for record in found
            if arguments.module in (None, record.get("module"))
            and (arguments.all_robots or record.get("robot", "") in ("", robot))
        ]
        lines = [incident_line(record) for record in fitting[: arguments.entries]]
        return IncidentsResult(
            kinds=incident_kinds(fitting, incidents.spans),
            incidents=lines,
            more=len(fitting) - len(lines),
            since=str(found[-1].get("at", "")) if len(found) == KEPT else "",
            directory=directory,
        )

    return [
        Tool(
            name="get_logs",
            title="Log of a module or of the server",
            description="The newest entries of a module's log, even after it has ended, or of the "
            "server's log.",
            arguments=GetLogs,
            result=LogsResult,
            handler=get_logs,
            read_only=True,
            idempotent=True,
            seldom=True,
        ),
        Tool(
            name="list_incidents",
            title="What went wrong",
            description=(
                "Faults of this robot: `kinds` with counts, severity, longest and whether it is so "
                "now; then the newest, a line each. With `id` one of them in full. Kept across "
                "restarts of the server."
            ),
            arguments=ListIncidents,
            result=IncidentsResult,
            handler=list_incidents,
            read_only=True,
            idempotent=True,
        ),
    ]
