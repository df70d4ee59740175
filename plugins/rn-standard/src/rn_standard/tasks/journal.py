"""Tool get_journal: every motion of this server's robot, from the history of tasks."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, Protocol, runtime_checkable

from pydantic import Field

from rn_standard.tasks.history import RUN_TASK, MotionFacts, PastTask, TaskHistory
from roboneuron import Arguments, CallContext, Host, InvalidInputError, Result, Tool
from roboneuron.feature import EndedCall, IncomingCall, Report

Kind = Literal["task", "instruction", "tool", "lead", "stop"]
_WORDS = 200
_TOGETHER_S = 2.0
"""Calls of one tool and client with pauses shorter than this are one entry, if each is short."""
_SHORT_S = 0.3
_BUCKET_S = 0.25
"""Speeds are kept by parts of a second."""
_STOPS = frozenset({"stop_motion", "emergency_stop"})
_LEADS = frozenset({"lead_arm", "hand_back"})
_OTHERS = frozenset({"play_recording"})
_UNMOVED = frozenset({"invalid_input", "internal"})
"""Codes of errors of calls that have moved nothing."""


class GetJournal(Arguments):
    """Arguments of get_journal."""

    since: str = Field(
        default="", max_length=40, description="Only what ended later, ISO 8601 with its zone."
    )
    kind: Kind | None = Field(default=None, description="Only this kind.")
    entries: int = Field(default=20, ge=1, le=50, description="At most so many.")
    skip: int = Field(default=0, ge=0, description="Newer ones that are left out: the next page.")
    all_robots: bool = Field(default=False, description="Of other robots too.")


class JournalEntry(PastTask):
    """A motion."""

    sparse = True
    kind: Kind


class Journal(Result):
    """Motions, newest first."""

    sparse = True

    entries: list[JournalEntry]
    more: int = Field(description="older ones that fit the call")


@runtime_checkable
class MeasuresSpeed(Protocol):
    """A feature that measures the speed of the TCP."""

    def fastest_m_s(self, since_s: float) -> float | None:
        """Highest speed since a monotonic time [s], to `_BUCKET_S`, of any arm [m/s]; None if not
        measured.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class _MotionStart:
    """What was so when a call began: monotonic time, and the newest report of control."""

    began_s: float
    report: Report | None


@dataclass(kw_only=True, slots=True)
class _Row:
    """Short calls of one tool that are written as one entry."""

    key: tuple[str, ...]
    words: str
    begun: _MotionStart
    ended_s: float
    at: datetime
    facts: MotionFacts
    reason: str
    calls: int = 1

    def is_followed_by(self, other: _Row) -> bool:
        """True if another call is like this one and came soon after it."""
        pause_s = other.begun.began_s - self.ended_s
        return self.key == other.key and pause_s < _TOGETHER_S


class MotionJournal:
    """Writes what clients' calls have moved into the history; usable from any thread.

    Args:
        host: the server.
        history: of tasks; run_task writes its own end.
    """

    def __init__(self, host: Host, history: TaskHistory) -> None:
        self._host, self._history = host, history
        self._lock = threading.Lock()
        self._begun: dict[int, _MotionStart] = {}
        self._stopped_s = -math.inf
        self._row: _Row | None = None
        host.events.call_begun.listen(self._on_begin)
        host.events.call_ended.listen(self._on_end)

    def fastest_m_s(self, past_s: float) -> float | None:
        """Highest speed of the TCP within the last seconds [m/s]; None if not measured."""
        speed = self._fastest(time.monotonic() - past_s) if past_s > 0 else None
        return None if speed is None else round(speed, 3)

    def facts_since(self, begun: _MotionStart, *, has_failed: bool = False) -> MotionFacts:
        """Highest speed, and the limits that acted, since then. Of a call that failed, which may
        have moved nothing, a part of a second that began before it is left out.
        """
        facts: MotionFacts = {}
        speed = self._fastest(begun.began_s + (_BUCKET_S if has_failed else 0.0))
        if speed is not None:
            facts["max_tcp_speed_m_s"] = round(speed, 3)
        before, now = _limits(begun.report), _limits(self._host.modules.view("control").report)
        acted = {name: count - before.get(name, 0) for name, count in now.items()}
        if acted := {name: count for name, count in acted.items() if count > 0}:
            facts["limits"] = acted
        return facts

    def flush(self) -> None:
        """Write short calls that were put together."""
        with self._lock:
            row, self._row = self._row, None
        if row is not None:
            self._write(row)

    def _on_begin(self, call: IncomingCall) -> None:
        if call.name in _STOPS:
            self._stopped_s = time.monotonic()
        # judged at its end: what comes before a message is sent has to be short
        report = self._host.loop.modules.slot("control").report
        self._begun[id(call)] = _MotionStart(began_s=time.monotonic(), report=report)

    def _on_end(self, ended: EndedCall) -> None:
        begun = self._begun.pop(id(ended.call), None)
        if begun is None or ended.outcome == "asked" or ended.code in _UNMOVED:
            return
        if kind_of(ended.call) in (None, "task"):
            return
        call, answer = ended.call, ended.answer
        structured = {} if answer is None else answer.structured
        outcome = ended.code or ("done" if ended.outcome == "answered" else ended.outcome)
        if ended.code and call.name not in _STOPS and self._stopped_s > begun.began_s:
            outcome = "stopped"
        row = _Row(
            key=(call.name, call.context.who, str(structured.get("outcome") or outcome)),
            words=_words(call.arguments),
            begun=begun,
            ended_s=time.monotonic(),
            at=datetime.now(UTC),
            facts=self.facts_since(begun, has_failed=ended.error is not None),
            reason="" if ended.error is None else ended.error.message,
        )
        told = ("objects_moved", "pushed", "others_moved")
        moved = next((structured[name] for name in told if structured.get(name)), None)
        objects = list(moved) if isinstance(moved, list) else []
        with self._lock:
            last = self._row
            is_short = ended.took_s < _SHORT_S and not objects
            if is_short and last is not None and last.is_followed_by(row):
                row.begun, row.calls = last.begun, last.calls + 1
                row.facts = self.facts_since(row.begun, has_failed=ended.error is not None)
                self._row = row
                return
            self._row = row if is_short else None
        if last is not None:
            self._write(last)
        if not is_short:
            self._write(row, objects)

    def _write(self, row: _Row, objects: list[object] | None = None) -> None:
        tool, who, outcome = row.key
        facts: MotionFacts = {**row.facts, "tool": tool, "who": who, "calls": row.calls}
        if objects:
            facts["objects_moved"] = objects
        took_s = row.ended_s - row.begun.began_s
        self._history.note(row.words, outcome, row.reason, took_s=took_s, at=row.at, **facts)

    def _fastest(self, since_s: float) -> float | None:
        loaded = self._host.features.loaded.values()
        speeds = [one.fastest_m_s(since_s) for one in loaded if isinstance(one, MeasuresSpeed)]
        return max((speed for speed in speeds if speed is not None), default=None)

    def tool(self) -> Tool[GetJournal]:
        """get_journal."""

        async def get_journal(arguments: GetJournal, context: CallContext) -> Journal:
            since = _time(arguments.since)
            self.flush()
            found = await context.run(
                lambda _: self._history.newest(tool="", all_robots=arguments.all_robots)
            )
            entries = [
                JournalEntry(kind=kind, **one.model_dump(exclude_defaults=True))
                for one in found
                if (kind := _kind(one.tool, one.instruction)) in (arguments.kind or kind,)
                and (since is None or datetime.fromisoformat(one.at) >= since)
            ][arguments.skip :]
            shown = entries[: arguments.entries]
            return Journal(entries=shown, more=len(entries) - len(shown))

        return Tool(
            name="get_journal",
            title="What moved the robot",
            description="Every motion of this robot, newest first: words, tool, outcome, how long, "
            "highest speed of the TCP, limits that acted. For questions about what was done.",
            arguments=GetJournal,
            result=Journal,
            handler=get_journal,
            read_only=True,
            idempotent=True,
        )


def kind_of(call: IncomingCall) -> Kind | None:
    """Kind of motion that a call asks for; None for one that moves nothing."""
    tool = call.found
    if tool is None or call.context.simulated:
        return None
    if call.name in _STOPS | _LEADS | _OTHERS or tool.simulated_by:
        return _kind(call.name, "")
    if call.arguments.get("instruction"):
        return "instruction"
    return None


def _kind(tool: str, words: str) -> Kind:
    if tool == RUN_TASK:
        return "task"
    if tool in _STOPS:
        return "stop"
    if tool in _LEADS:
        return "lead"
    is_instruction = tool == "set_instruction" or tool.startswith("start_")
    return "instruction" if is_instruction else "tool"


def _limits(report: Report | None) -> dict[str, int]:
    """How many commands each limit has acted on, since control was started."""
    return {
        name.removeprefix("limited."): int(float(value))
        for name, value in ({} if report is None else report.metrics).items()
        if name.startswith("limited.")
    }


def _words(arguments: Mapping[str, object]) -> str:
    text = str(arguments.get("instruction") or "")
    return text or (json.dumps(dict(arguments), default=str)[:_WORDS] if arguments else "")


def _time(text: str) -> datetime | None:
    """Raises InvalidInputError for what is no time with a zone."""
    if not text:
        return None
    try:
        time_ = datetime.fromisoformat(text)
    except ValueError:
        time_ = None
    if time_ is None or time_.tzinfo is None:
        raise InvalidInputError(
            f"`since` is {text!r}, not a time with its zone.",
            hint='Such as "2026-11-28T10:00:00+00:00".',
            path="since",
        )
    return time_
