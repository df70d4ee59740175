"""Status report of a module: key-value pairs on /diagnostics, written and parsed by one class."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator
from pydantic import ValidatorFunctionWrapHandler as Parse

from roboneuron.errors import InternalError, RoboNeuronError
from roboneuron.modules.settings import FAULT_DETAIL, FOLLOWING_NOTE, HOLDING_NOTE

_MOST_PAIRS, _MOST_KEY, _MOST_VALUE, _MOST_REPORT = 128, 100, 2000, 6000
"""Of the reports that are kept: any node can publish one [characters; the last, all values]."""
_TABLES = {"dropped": "dropped_by", "detail": "detail"}
"""Fields of several pairs, by the prefix before the dot in their keys."""


class ModuleFacts(BaseModel):
    """Facts from a module's newest report; None or empty if not reported.

    Attributes:
        ready: the module has proved that it works: robot and perception have published a first
            state or image, control has received a first joint state and published `ee_pose`,
            inference has received every input it needs and, when it has an instruction, published a
            first action.
        error_count: never decreases.
        work_age_s, work_limit_s: of the slowest of the module's threads.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    ready: bool = Field(default=False, description="has proved that it works, and still reports")
    state: str = Field(
        default="", description="lifecycle state: unconfigured, configuring, inactive, active"
    )
    uptime_s: float | None = None
    rate_hz: float | None = Field(default=None, description="rate of its output")
    latency_ms: float | None = Field(
        default=None, description="median from its input's stamp to its output"
    )
    latency_p99_ms: float | None = None
    age_ms: float | None = Field(default=None, description="age of its newest input or output")
    loop_age_s: float | None = Field(
        default=None, description="time since its executor last ran; grows when it hangs"
    )
    work_age_s: float | None = Field(
        default=None, description="time since its work last made progress"
    )
    work_limit_s: float | None = Field(
        default=None, description="from this age on it counts as stalled"
    )
    published: int = 0
    dropped: int = Field(default=0, description="inputs not acted on, see `dropped_by`")
    dropped_by: dict[str, int] = Field(default_factory=dict)
    waiting_for: str = Field(default="", description="what is missing until it is ready")
    instruction: str = ""
    actions_for_instruction: int = Field(
        default=0, description="actions published for the present instruction"
    )
    note: str = Field(default="", description="what it is doing, as text")
    error_count: int = 0
    emergency_stop: bool | None = Field(
        default=None, description="whether the module itself is latched"
    )
    needs_start: str = Field(
        default="", description="the stop after which it waits to be asked for motion again"
    )
    metrics: dict[str, str] = Field(default_factory=dict, description="whatever else it reports")
    detail: dict[str, str] = Field(
        default_factory=dict, description="facts of the robot or simulator"
    )


class Report(ModuleFacts):
    """One status report. On the wire each field is one pair with the field's name.

    Attributes:
        error_code, error, error_hint: the newest failure; empty again once the module works.
        event, event_text, event_count: word and explanation of the newest event that is no error,
            and the number of events since the start.
        instruction_count: changes of the instruction since the start.
        stops: stops that this process has seen: emergency stops, faults of the robot, a silent
            server.
        received_s: monotonic time of its arrival [s]; not on the wire.
    """

    model_config = ConfigDict(allow_inf_nan=False)

    error_code: str = ""
    error: str = ""
    error_hint: str = ""
    event: str = ""
    event_text: str = ""
    event_count: int = 0
    instruction_count: int = 0
    stops: int = 0
    received_s: float = 0.0

    def to_values(self) -> dict[str, str]:
        """Return the key-value pairs of a DiagnosticStatus; fields that are None are left out.

        Tables become one pair per entry, such as `dropped.stale_action`; metrics keep their names.
        """
        values = {
            name: to_text(value)
            for name, value in self.model_dump(include=set(_PLAIN), exclude_none=True).items()
        }
        for prefix, table in _TABLES.items():
            values |= {f"{prefix}.{key}": str(told) for key, told in getattr(self, table).items()}
        return values | self.metrics

    @classmethod
    def from_values(cls, values: Mapping[str, str], received_s: float = 0.0) -> Self:
        """Parse the pairs. A malformed value counts as not reported, so that a report of another
        version stays usable.

        Args:
            values: as written by `to_values`.
            received_s: monotonic time of arrival [s].
        """
        plain: dict[str, str] = {}
        tables: dict[str, dict[str, str]] = {"dropped_by": {}, "detail": {}, "metrics": {}}
        left = _MOST_REPORT
        for key, text in list(values.items())[:_MOST_PAIRS]:
            key, text = key[:_MOST_KEY], text[: min(_MOST_VALUE, left)]
            left -= len(text)
            prefix, dot, name = key.partition(".")
            if key in _PLAIN:
                plain[key] = text
            elif dot and prefix in _TABLES:
                tables[_TABLES[prefix]][name] = text
            else:
                tables["metrics"][key] = text
        return cls.model_validate({**plain, **tables, "received_s": received_s})

    @field_validator("*", mode="wrap")
    @classmethod
    def _or_not_said(cls, value: object, parse: Parse, info: ValidationInfo) -> object:
        """Return the parsed field, or its default if it cannot be parsed."""
        try:
            return parse(value)
        except ValidationError:
            return cls.model_fields[info.field_name or ""].get_default(call_default_factory=True)

    @property
    def is_following(self) -> bool:
        """True for control while it follows requests, that is, does not hold."""
        return self.note == FOLLOWING_NOTE

    @property
    def held(self) -> tuple[str, str]:
        """Why control holds the arm: a code such as the name of a limit, and a sentence; empty if
        it does not.
        """
        if not self.note.startswith(HOLDING_NOTE):
            return "", ""
        return self.metrics.get("hold_code", ""), self.note.removeprefix(HOLDING_NOTE)

    @property
    def fault(self) -> str:
        """The fault that a robot's driver reports; empty for none."""
        return self.detail.get(FAULT_DETAIL, "")

    def failure(self) -> RoboNeuronError | None:
        """The module's newest error as an exception of its own class; None without an error.

        A code that is unknown in this process becomes an InternalError.
        """
        if not self.error_code:
            return None
        return _subclasses(RoboNeuronError).get(self.error_code, InternalError)(
            self.error, hint=self.error_hint
        )


_PLAIN = frozenset(Report.model_fields) - {*_TABLES.values(), "metrics", "received_s"}
"""Fields with exactly one pair."""


def to_text(value: str | float | int | bool) -> str:
    """Format a value for the wire.

    Args:
        value: floats get six significant digits, truth values the words of JSON.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _subclasses(base: type[RoboNeuronError]) -> dict[str, type[RoboNeuronError]]:
    """All error classes by code, `base` and those of imported plugins included. A class that
    inherits its code stands behind its base, because its constructor may take other arguments.
    """
    found = {base.code: base}
    for child in base.__subclasses__():
        found = _subclasses(child) | found
    return found
