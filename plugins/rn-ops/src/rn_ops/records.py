"""The tools by which an agent reads what happened: the modules' logs and the incident records."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from rn_ops.incidents import Incidents
from rn_ops.server_log import FILE_NAME
from roboneuron import Arguments, CallContext, Resource, Result, Tool
from roboneuron.modules.settings import ModuleKind
from roboneuron.supervisor.process import read_tail
from roboneuron.supervisor.supervisor import Supervisor

Level = Literal["debug", "info", "warning", "error"]
Source = Literal["robot", "perception", "inference", "control", "server"]
_LEVELS: tuple[Level, ...] = ("debug", "info", "warning", "error")
_RANK = {"DEBUG": 0, "INFO": 1, "WARNING": 2, "ERROR": 3, "CRITICAL": 3}
_ENTRY = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3}) (\w+) ([\w.\-]+): (.*)")
LOG_LINES = 500
_MOST_LINES = 2000
_MOST_TEXT = 4000


class GetLogs(Arguments):
    """Arguments of get_logs."""

    module: Source = Field(description="Whose log; server: the log of this server itself.")
    entries: int = Field(default=50, ge=1, le=500, description="Most entries; the newest are given.")
    level: Level = Field(default="debug", description="Leave out entries below this level.")
    contains: str = Field(default="", max_length=200, description="Only entries with this text.")


class LogEntry(Result):
    """One entry; `level` is empty for what was not written by the logger (a plugin's or library's own output)."""

    at: str = Field(default="", description="local time")
    level: str = ""
    logger: str = ""
    text: str


class LogsResult(Result):
    """The newest entries, oldest first."""

    module: Source
    entries: list[LogEntry]
    path: str = Field(description="the whole log, on the server's host")


class ListIncidents(Arguments):
    """Arguments of list_incidents."""

    entries: int = Field(default=10, ge=1, le=100, description="Most records; the newest are given.")
    module: ModuleKind | None = Field(default=None, description="Only of this module.")


class Incident(Result):
    """One fault."""

    id: str
    at: str = Field(description="ISO 8601")
    module: str
    what: str = Field(description="failing, stalled, stuck, silent, exited, restart ...")
    before: str = Field(default="", description="how it was before")
    explanation: str = ""
    status: dict[str, Any] = Field(default_factory=dict, description="the module's last status, as in get_status")
    log: list[str] = Field(default_factory=list, description="the end of its log")
    actions: list[dict[str, Any]] = Field(
        default_factory=list, description="the last actions on the action topic: when they were sent, and their values"
    )


class IncidentsResult(Result):
    """The newest records, newest first."""

    incidents: list[Incident]
    directory: str = Field(description="where the records are, on the server's host")


def parse_entries(lines: tuple[str, ...]) -> list[LogEntry]:
    """Log lines as entries; lines that continue one (a traceback) belong to it."""
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


def log_file(supervisor: Supervisor, source: Source) -> Path:
    """Where a module, or the server itself, logs."""
    return supervisor.log_directory / FILE_NAME if source == "server" else supervisor.log_path(source)


def log_resource(supervisor: Supervisor, source: Source) -> Resource:
    """The end of a module's log, or of the server's."""
    return Resource(
        uri=f"roboneuron://logs/{source}",
        name=f"log of {source}",
        title=f"Log of {source}",
        description=f"The last {LOG_LINES} lines that {source} has written.",
        read=lambda: "\n".join(read_tail(log_file(supervisor, source), lines=LOG_LINES)),
    )


def record_tools(supervisor: Supervisor, incidents: Incidents) -> list[Tool[Any]]:
    """get_logs and list_incidents."""

    async def get_logs(arguments: GetLogs, context: CallContext) -> LogsResult:
        path = log_file(supervisor, arguments.module)
        least = _LEVELS.index(arguments.level)
        entries = [
            entry
            for entry in parse_entries(await context.run(lambda _: read_tail(path, lines=_MOST_LINES)))
            if _RANK.get(entry.level.upper(), 1) >= least and arguments.contains in entry.text
        ]
        return LogsResult(module=arguments.module, entries=entries[-arguments.entries :], path=str(path))

    async def list_incidents(arguments: ListIncidents, context: CallContext) -> IncidentsResult:
        found = await context.run(lambda _: incidents.listing(200))
        known = set(Incident.model_fields)
        records = [
            Incident.model_validate({key: value for key, value in record.items() if key in known})
            for record in found
            if arguments.module is None or record.get("module") == arguments.module
        ]
        return IncidentsResult(incidents=records[: arguments.entries], directory=str(incidents.directory))

    return [
        Tool(
            name="get_logs",
            title="Log of a module or of the server",
            description="The newest entries of a module's log, also after it has ended, or of the server's own.",
            arguments=GetLogs,
            result=LogsResult,
            handler=get_logs,
            read_only=True,
            idempotent=True,
        ),
        Tool(
            name="list_incidents",
            title="What went wrong",
            description=(
                "Records of faults: a module that ended, froze, stalled or failed, and every restart; with its last "
                "status, the end of its log and the last actions. Kept across restarts of the server."
            ),
            arguments=ListIncidents,
            result=IncidentsResult,
            handler=list_incidents,
            read_only=True,
            idempotent=True,
        ),
    ]
