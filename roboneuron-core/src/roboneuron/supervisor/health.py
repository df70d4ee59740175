"""What modules say of themselves on /diagnostics, as typed reports."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from roboneuron.errors import InternalError, RoboNeuronError
from roboneuron.modules.settings import MODULE_KINDS, StatusKey
from roboneuron.supervisor.changes import Changes

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

_KNOWN = frozenset(value for key, value in vars(StatusKey).items() if key.isupper())
_DETAIL, _DROPPED = "detail.", "dropped."
_KINDS = tuple(f"/{kind}" for kind in MODULE_KINDS)
_STRANGER_S = 1.0
_STRANGERS = 64


@dataclass(frozen=True, kw_only=True, slots=True)
class Report:
    """One module's newest status; numbers are None when the module does not say them.

    Attributes:
        received_s: monotonic time of arrival.
        rate_hz, latency_ms, latency_p99_ms, age_ms: of the module's output, as `StatusKey` says.
        dropped_by: number of dropped inputs by reason.
        detail: facts of the robot or simulator.
        metrics: whatever else the module reports.
    """

    received_s: float
    state: str
    ready: bool
    waiting_for: str = ""
    error_code: str = ""
    error: str = ""
    error_hint: str = ""
    error_count: int = 0
    uptime_s: float | None = None
    loop_age_s: float | None = None
    work_age_s: float | None = None
    work_limit_s: float | None = None
    rate_hz: float | None = None
    latency_ms: float | None = None
    latency_p99_ms: float | None = None
    age_ms: float | None = None
    dropped: int = 0
    published: int = 0
    instruction: str = ""
    instruction_count: int = 0
    actions_for_instruction: int = 0
    note: str = ""
    emergency_stop: bool | None = None
    dropped_by: Mapping[str, int] = field(default_factory=dict)
    detail: Mapping[str, str] = field(default_factory=dict)
    metrics: Mapping[str, str] = field(default_factory=dict)

    def failure(self) -> RoboNeuronError | None:
        """The module's newest error as an exception of its own class, or None when it works."""
        return to_error(self.error_code, self.error, self.error_hint) if self.error_code else None


def _subclasses(base: type[RoboNeuronError]) -> dict[str, type[RoboNeuronError]]:
    found = {base.code: base}
    for child in base.__subclasses__():
        found.update(_subclasses(child))
    return found


def to_error(code: str, message: str, hint: str = "") -> RoboNeuronError:
    """The exception that `code` names; InternalError for a code nobody knows."""
    return _subclasses(RoboNeuronError).get(code, InternalError)(message, hint=hint)


def _number(text: str | None) -> float | None:
    try:
        value = float(text) if text else None
    except ValueError:
        return None
    return value if value is not None and math.isfinite(value) else None


def _count(text: str | None) -> int:
    return int(_number(text) or 0)


def parse_report(values: Mapping[str, str], *, received_s: float) -> Report:
    """Read the key-value pairs of a DiagnosticStatus; what is malformed counts as not said."""
    stop = values.get(StatusKey.EMERGENCY_STOP)
    return Report(
        received_s=received_s,
        state=values.get(StatusKey.STATE, "unknown"),
        ready=values.get(StatusKey.READY) == "true",
        waiting_for=values.get(StatusKey.WAITING_FOR, ""),
        error_code=values.get(StatusKey.ERROR_CODE, ""),
        error=values.get(StatusKey.ERROR, ""),
        error_hint=values.get(StatusKey.ERROR_HINT, ""),
        error_count=_count(values.get(StatusKey.ERROR_COUNT)),
        uptime_s=_number(values.get(StatusKey.UPTIME_S)),
        loop_age_s=_number(values.get(StatusKey.LOOP_AGE_S)),
        work_age_s=_number(values.get(StatusKey.WORK_AGE_S)),
        work_limit_s=_number(values.get(StatusKey.WORK_LIMIT_S)),
        rate_hz=_number(values.get(StatusKey.RATE_HZ)),
        latency_ms=_number(values.get(StatusKey.LATENCY_MS)),
        latency_p99_ms=_number(values.get(StatusKey.LATENCY_P99_MS)),
        age_ms=_number(values.get(StatusKey.AGE_MS)),
        dropped=_count(values.get(StatusKey.DROPPED)),
        published=_count(values.get(StatusKey.PUBLISHED)),
        instruction=values.get(StatusKey.INSTRUCTION, ""),
        instruction_count=_count(values.get(StatusKey.INSTRUCTION_COUNT)),
        actions_for_instruction=_count(values.get(StatusKey.ACTIONS_FOR_INSTRUCTION)),
        note=values.get(StatusKey.NOTE, ""),
        emergency_stop=None if stop is None else stop == "true",
        dropped_by={k.removeprefix(_DROPPED): _count(v) for k, v in values.items() if k.startswith(_DROPPED)},
        detail={k.removeprefix(_DETAIL): v for k, v in values.items() if k.startswith(_DETAIL)},
        metrics={k: v for k, v in values.items() if k not in _KNOWN and not k.startswith((_DETAIL, _DROPPED))},
    )


class StatusBoard:
    """The newest report of each watched module process; every method may be called from any thread."""

    def __init__(self, changes: Changes) -> None:
        self._changes = changes
        self._reports: dict[tuple[str, str], Report | None] = {}
        self._ours: set[str] = set()
        self._strangers: dict[str, tuple[str, float]] = {}

    def watch(self, name: str, pid: int) -> None:
        """Accept reports of the process `pid` under the status name `name`; those of anybody else are ignored."""
        with self._changes.lock:
            self._reports[name, str(pid)] = None
            self._ours.add(str(pid))

    def forget(self, name: str, pid: int) -> None:
        """Stop watching."""
        with self._changes.lock:
            self._reports.pop((name, str(pid)), None)

    def newest(self, name: str, pid: int) -> Report | None:
        """The newest report, or None before the first."""
        with self._changes.lock:
            return self._reports.get((name, str(pid)))

    def stranger(self, name: str) -> str | None:
        """Pid of a process of somebody else that reported under `name` within the last second, or None."""
        with self._changes.lock:
            pid, seen_s = self._strangers.get(name, ("", 0.0))
        return pid if pid and time.monotonic() - seen_s < _STRANGER_S else None

    def receive(self, message: DiagnosticArray) -> None:
        """Subscription callback of /diagnostics."""
        now_s = time.monotonic()
        with self._changes.lock:
            for status in message.status:
                key = (status.name, status.hardware_id)
                if key in self._reports:
                    self._reports[key] = parse_report({v.key: v.value for v in status.values}, received_s=now_s)
                elif status.name.endswith(_KINDS) and status.hardware_id not in self._ours:
                    self._strangers = dict(list(self._strangers.items())[-_STRANGERS:])
                    self._strangers[status.name] = (status.hardware_id, now_s)
        self._changes.notify()
