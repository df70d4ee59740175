"""State of the modules at one moment, from `get_status` or from /diagnostics, as one model."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import BaseModel, ConfigDict, Field, field_validator

from roboneuron import foreign
from roboneuron.feature import FAULTS, Health, Report


class ModuleError(BaseModel):
    """The newest error of a module that does not work."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    code: str = ""
    message: str = ""
    hint: str = ""


class ReportedReason(BaseModel):
    """Why the robot does not move, see `Host.why_still`."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    rule: str
    message: str
    hint: str = ""


class ReportedModule(BaseModel):
    """One module; the fields are those of `get_status`, None if the source lacks them."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    module: str
    health: str
    pid: int | None = None
    uptime_s: float | None = None
    rate_hz: float | None = None
    latency_ms: float | None = None
    latency_p99_ms: float | None = None
    age_ms: float | None = None
    published: int = 0
    dropped: int = 0
    waiting_for: str = ""
    instruction: str = ""
    note: str = ""
    error: ModuleError | None = None
    metrics: dict[str, str] = Field(default_factory=dict)
    detail: dict[str, str] = Field(default_factory=dict)

    @property
    def is_faulty(self) -> bool:
        """True if it does not work."""
        return self.health in FAULTS

    @classmethod
    def from_report(cls, module: str, pid: int, health: Health, report: Report) -> ReportedModule:
        """Create it from a module's report on /diagnostics."""
        # any node can publish a report, and a module's error may quote an agent or a server
        printable = foreign.printable
        failure = ModuleError(
            code=printable(report.error_code),
            message=printable(report.error),
            hint=printable(report.error_hint),
        )
        names = set(cls.model_fields) & {
            "uptime_s",
            "rate_hz",
            "latency_ms",
            "latency_p99_ms",
            "age_ms",
        }
        return cls(
            module=module,
            health=health,
            pid=pid,
            **{name: getattr(report, name) for name in sorted(names)},
            published=report.published,
            dropped=report.dropped,
            waiting_for=printable(report.waiting_for),
            instruction=printable(report.instruction),
            note=printable(report.note),
            error=failure if report.error_code else None,
            metrics=dict(report.metrics),
            detail=dict(report.detail),
        )


class ServerStatus(BaseModel):
    """A server and its modules.

    Attributes:
        source: description of the source.
        pid: process id of the server; None if unknown.
        emergency_stop: True if latched.
        why_still: why the robot does not move; empty from a source that does not know.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    source: str = ""
    namespace: str = ""
    pid: int | None = None
    uptime_s: float | None = None
    emergency_stop: bool = False
    emergency_stop_cause: str = ""
    why_still: tuple[ReportedReason, ...] = ()
    log_directory: str = ""
    modules: tuple[ReportedModule, ...] = ()

    def module(self, name: str) -> ReportedModule | None:
        """The module of that name that has a process, or None."""
        return next((m for m in self.modules if m.module == name and m.pid is not None), None)

    @property
    def running(self) -> tuple[ReportedModule, ...]:
        """Running modules, and those that have ended by themselves."""
        return tuple(m for m in self.modules if m.health != "stopped")

    @classmethod
    def from_answer(cls, answer: Mapping[str, object], source: str) -> ServerStatus:
        """Parse the answer of `get_status`."""
        return cls.model_validate({**answer, "source": source})

    @field_validator("emergency_stop_cause")
    @classmethod
    def _shown(cls, cause: str) -> str:
        return foreign.printable(cause, 500)
