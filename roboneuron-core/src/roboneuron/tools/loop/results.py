"""Results of the closed-loop tools; the field descriptions are part of the output schemas."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Literal, Self

from pydantic import Field

from roboneuron.gate import StillReason
from roboneuron.modules.report import ModuleFacts
from roboneuron.modules.settings import ModuleKind
from roboneuron.server.tool import Result
from roboneuron.supervisor.health import EXPLANATIONS, Health, ModuleView
from roboneuron.supervisor.slot import Phase

__all__ = ["ModuleStatus", "ModuleSummary"]
"""Names that other distributions may use."""

STALE_S = 1.0
"""Age of a module's newest report (five periods) from which it is shown as not responding."""


_DETAILS = frozenset(
    {
        *("metrics", "dropped_by", "latency_ms", "latency_p99_ms", "age_ms", "report_age_s"),
        *("loop_age_s", "work_age_s", "work_limit_s"),
    }
)
"""Fields of a module's status that only an answer with details has."""
_MOST_TEXT, _MOST_TABLE, _MOST_LINE = 1000, 6000, 300
"""Maximum characters of one text, of one table and of one log line in the status of a module."""


class Failure(Result):
    """A module's newest error."""

    code: str = Field(description="stable machine-readable word")
    message: str
    hint: str = ""


class ExitInfo(Result):
    """End of a module that ended by itself."""

    pid: int
    code: int = Field(description="exit code; negative for the signal that ended it")
    at: str = Field(description="ISO 8601 time at which it was noticed")
    last_lines: list[str] = Field(description="the end of its log")


class ModuleSummary(Result):
    """Summary of a module; get_status has all details."""

    module: ModuleKind
    phase: Phase
    health: Health
    pid: int | None = None
    started_with: dict[str, str] = Field(
        default_factory=dict, description="what was chosen: backend, camera ..."
    )

    @classmethod
    def short_of(cls, view: ModuleView, **more: object) -> Self:
        """Create the summary of a module, with the additional fields of a subclass."""
        return cls.model_validate({**_summary(view), **more})


class ModuleStatus(ModuleFacts, ModuleSummary):
    """Status of one module: activity, rates, ages and errors."""

    phase: Phase = Field(description="exited: it ended by itself, see `exit`")
    health: Health = Field(
        default="stopped",
        description="how it is: "
        + "; ".join(f"{word}: {meaning}" for word, meaning in EXPLANATIONS.items()),
    )
    responding: bool = Field(default=False, description="its newest report is at most 1 s old")
    started_at: str | None = Field(default=None, description="ISO 8601")
    report_age_s: float | None = Field(default=None, description="time since its newest report")
    error: Failure | None = None
    exit: ExitInfo | None = None
    log: str | None = Field(default=None, description="resource with its log")

    @classmethod
    def of(cls, view: ModuleView, *, details: bool = True) -> ModuleStatus:
        """Create the status of a module for the agent, with the texts of its own report; without
        details, what matters to those who look for causes is left out.
        """
        facts = _facts(view)
        kept = {name: value for name, value in facts.items() if details or name not in _DETAILS}
        return _known(kept, view.phase)


class StartResult(ModuleSummary):
    """A module that is running and has passed its readiness check."""

    sparse = True
    took_s: float = Field(description="from the call to the proof of readiness")
    unchecked: str = Field(
        default="",
        description="why places or distances of its links are not checked, and what to do",
    )


class InstructionResult(Result):
    """The backend has published its first action for the new instruction."""

    instruction: str
    took_s: float = Field(description="from the call to the first action")
    note: str = ""


class RobotStatus(Result):
    """The running robot, or else the configured one."""

    name: str
    driver: str
    kind: Literal["real", "simulated"] = Field(
        description="real unless its driver declares that it is simulated"
    )
    unchecked: str = Field(
        default="",
        description="why places or distances of its links are not checked, and what to do",
    )


class ReasonResult(Result):
    """Why the robot does not move, by one mechanism."""

    rule: str = Field(description="as in refusals")
    message: str
    hint: str = Field(default="", description="what to do next")

    @classmethod
    def of(cls, reason: StillReason) -> Self:
        """The reason in an answer."""
        return cls(rule=reason.rule, message=reason.message, hint=reason.hint)


class StatusResult(Result):
    """Complete status; unknown fields are left out, and for a stopped module also fields that are
    empty, 0 or false.
    """

    sparse = True

    summary: str = Field(description="how it is, in a sentence")
    why_still: list[ReasonResult] = Field(
        default_factory=list,
        description="what keeps the robot from moving for this client, in the order in which to "
        "remove it; left out: nothing does",
    )
    robot: RobotStatus
    modules: list[ModuleStatus]
    emergency_stop: bool = Field(
        description="latched here or in any module; nothing moves until it is reset"
    )
    emergency_stop_cause: str = Field(default="", description="who latched it and why")
    namespace: str = Field(description="ROS namespace of the robot")
    tightened_limits: dict[str, object] = Field(
        default_factory=dict,
        description="limits tightened below those of the configuration; a person loosens them",
    )
    left_out: list[str] = Field(
        default_factory=list, description="of the configuration, with the reason"
    )
    uptime_s: float = Field(description="of the server")
    pid: int = Field(description="of the server")
    versions: dict[str, str] = Field(default_factory=dict, description="with details")
    log_directory: str


def _summary(view: ModuleView) -> dict[str, object]:
    return {
        "module": view.kind,
        "phase": view.phase,
        "health": view.health(time.monotonic()),
        "pid": view.process.pid if view.process is not None and view.phase != "exited" else None,
        "started_with": dict(view.plan.names) if view.plan is not None else {},
    }


def _facts(view: ModuleView) -> dict[str, object]:
    process, report = view.process, view.report
    facts: dict[str, object] = {
        **_summary(view),
        "ready": False,
        "started_at": process.started_at.isoformat(timespec="seconds")
        if process is not None
        else None,
        "log": f"roboneuron://logs/{view.kind}",
    }
    if view.phase == "exited" and process is not None:
        at = process.ended_at.isoformat(timespec="milliseconds")
        lines = [_clipped(line, _MOST_LINE) for line in process.last_lines()]
        code = process.exit_code or 0
        facts["exit"] = ExitInfo(pid=process.pid, code=code, at=at, last_lines=lines)
    if report is None:
        return facts
    age_s = time.monotonic() - report.received_s
    responding = age_s <= STALE_S
    failure = report.failure()
    facts |= {
        name: value for name, value in vars(report).items() if name in ModuleStatus.model_fields
    }
    facts["report_age_s"], facts["responding"] = round(age_s, 3), responding
    facts["ready"] = report.ready and responding and view.phase == "running"
    facts["error"] = (
        Failure(code=failure.code, message=failure.message, hint=failure.hint) if failure else None
    )
    if not responding:
        facts["rate_hz"], facts["note"] = 0.0, f"No report for {age_s:.1f} s."
    return facts


def _known(facts: Mapping[str, object], phase: Phase) -> ModuleStatus:
    """Facts with a value; unset fields are left out of answers."""
    empty: tuple[object, ...] = (None,) if phase != "stopped" else (None, "", {}, (), 0, False)
    kept = {
        name: _bounded(value)
        for name, value in facts.items()
        if name == "ready" or value not in empty
    }
    return ModuleStatus.model_validate(kept)


def _bounded(value: object) -> object:
    """Truncate a plugin's report to a readable size; the log and /diagnostics have the whole."""
    if isinstance(value, str):
        return _clipped(value, _MOST_TEXT)
    if not isinstance(value, Mapping):
        return value
    kept, room = {}, _MOST_TABLE
    for key, entry in value.items():
        room -= len(str(key)) + len(str(entry))
        if room >= 0:
            kept[key] = entry
    return kept


def _clipped(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[:most]} ... ({len(text)} characters)"
