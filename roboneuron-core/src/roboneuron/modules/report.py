"""What a module reports of itself: written as key-value pairs on /diagnostics, and read back by the
same class.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Self

from roboneuron.errors import InternalError, RoboNeuronError

_DETAIL, _DROPPED = "detail.", "dropped."


@dataclass(frozen=True, kw_only=True)
class StatusReport:
    """One report. On the wire each field is a pair of its own name; numbers are None when the
    module does not say them.

    Attributes:
        state: label of the lifecycle state.
        ready: the module has proved that it works: robot and perception have published a first
            state or image, control has received a first joint state and published `ee_pose`,
            inference has received every input it needs and, when it has an instruction, published a
            first action.
        waiting_for: what is missing until then.
        error_code, error, error_hint: the newest failure; empty again once the module works.
        error_count: never goes down.
        loop_age_s: time since the executor last turned.
        work_age_s, work_limit_s: time since the slowest of the module's threads last got on, and
            what it may be.
        rate_hz, latency_ms, latency_p99_ms, age_ms: of the module's output.
        dropped, dropped_by: inputs not acted on, and their number by reason.
        emergency_stop: whether the module itself is latched.
        stops: stops that this process has seen: emergency stops, faults of the robot, a silent
            server.
        needs_start: which of them keeps the module still until somebody asks for motion; empty
            otherwise.
        detail: facts of the robot or simulator.
        metrics: whatever else the module reports.
    """

    state: str = "unknown"
    ready: bool = False
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
    stops: int = 0
    needs_start: str = ""
    dropped_by: Mapping[str, int] = field(default_factory=dict)
    detail: Mapping[str, str] = field(default_factory=dict)
    metrics: Mapping[str, str] = field(default_factory=dict)

    def to_values(self) -> dict[str, str]:
        """The pairs of a DiagnosticStatus; what is None is left out."""
        values = {
            name: to_text(value) for name in _PLAIN if (value := getattr(self, name)) is not None
        }
        values |= {f"{_DROPPED}{reason}": str(count) for reason, count in self.dropped_by.items()}
        values |= {f"{_DETAIL}{key}": text for key, text in self.detail.items()}
        return values | dict(self.metrics)

    @classmethod
    def from_values(cls, values: Mapping[str, str], **more: Any) -> Self:
        """Read the pairs; what is malformed counts as not said. `more` are fields that are not on
        the wire.
        """
        return cls(
            **{name: parse(values[name]) for name, parse in _PLAIN.items() if name in values},
            dropped_by={
                k.removeprefix(_DROPPED): _count(v)
                for k, v in values.items()
                if k.startswith(_DROPPED)
            },
            detail={k.removeprefix(_DETAIL): v for k, v in values.items() if k.startswith(_DETAIL)},
            metrics={
                k: v
                for k, v in values.items()
                if k not in _PLAIN and not k.startswith((_DETAIL, _DROPPED))
            },
            **more,
        )

    def failure(self) -> RoboNeuronError | None:
        """The module's newest error as an exception of its own class, InternalError for a code that
        is not known here.

        None when it works.
        """
        if not self.error_code:
            return None
        return _subclasses(RoboNeuronError).get(self.error_code, InternalError)(
            self.error, hint=self.error_hint
        )


def to_text(value: str | float | int | bool) -> str:
    """A value as it is written; floats with six significant digits."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _subclasses(base: type[RoboNeuronError]) -> dict[str, type[RoboNeuronError]]:
    found = {base.code: base}
    for child in base.__subclasses__():
        found.update(_subclasses(child))
    return found


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _count(text: str) -> int:
    return int(_number(text) or 0)


_PARSERS: dict[str, Any] = {
    "str": str,
    "int": _count,
    "bool": lambda text: text == "true",
    "float | None": _number,
    "bool | None": lambda text: text == "true",
}
_PLAIN = {f.name: _PARSERS[str(f.type)] for f in fields(StatusReport) if f.type in _PARSERS}
"""How each field that is one pair is read, by its annotation."""
