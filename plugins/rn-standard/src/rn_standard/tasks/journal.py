"""Tool get_journal: motions of this server's robot, and changes of limits, policies and recordings,
from the history of tasks.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol, runtime_checkable

from pydantic import Field

from rn_standard.tasks.history import RUN_TASK, Kind, MotionFacts, PastTask, TaskHistory
from roboneuron import Arguments, CallContext, Host, InvalidInputError, Result, Tool
from roboneuron.feature import EndedCall, IncomingCall, Report

_WORDS = 200
_TOGETHER_S = 2.0
"""Calls of one tool and client with pauses shorter than this are one entry, if each is short."""
_SHORT_S = 0.3
_BUCKET_S = 0.25
"""Speeds are kept by parts of a second."""
_STOPS = frozenset({"stop_motion", "emergency_stop"})
_LEADS = frozenset({"lead_arm", "hand_back"})
_OTHERS = frozenset({"play_recording"})
_CHANGES: Mapping[str, Kind] = {
    **dict.fromkeys(("tighten_limits", "loosen_limits"), "limits"),
    **dict.fromkeys(("start_recording", "stop_recording"), "recording"),
    **dict.fromkeys(("switch_inference", "switch_perception", "switch_control"), "switch"),
    **dict.fromkeys(("start_inference", "stop_inference", "start_all", "stop_all"), "switch"),
}
"""Tools that move nothing; one that gives an instruction is an instruction."""
_TOLD = ("id", "module", "started_with", "replaced")
"""Fields of the answers of `_CHANGES` that belong to their words."""
_UNMOVED = frozenset({"invalid_input", "internal"})
"""Codes of errors of calls that have moved nothing."""


class GetJournal(Arguments):
    """Arguments of get_journal."""

    since: str = Field(
        default="", max_length=40, description="Only what ended later, ISO 8601 with zone."
    )
    kind: Kind | None = Field(default=None, description="Only these.")
    entries: int = Field(default=20, ge=1, le=50, description="At most so many.")
    skip: int = Field(default=0, ge=0, description="Newer ones to leave out, for pages.")
    all_robots: bool = Field(default=False, description="Of other robots too.")


class Journal(Result):
    """Motions and changes, newest first."""

    sparse = True

    entries: list[PastTask]
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
    kind: Kind
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
    """Writes what clients' calls have moved or changed into the history; usable from any thread.

    Args:
        host: the server.
        history: of tasks; run_task writes its own end.
    """

    def __init__(self, host: Host, history: TaskHistory) -> None:
        self._host, self._history = host, history
        # guards the row that calls in quick succession are merged into
        self._lock = threading.Lock()
        self._begun: dict[int, _MotionStart] = {}
        self._stopped_s = -math.inf
        self._row: _Row | None = None
        host.events.call_begun.listen(self._on_begin)
        host.events.call_ended.listen(self._on_end)
        host.events.uncalled.listen(self._on_uncalled)

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
        kind = kind_of(ended.call)
        if kind is None or kind == "task":
            return
        call, answer = ended.call, ended.answer
        structured = {} if answer is None else answer.structured
        is_change = kind in _CHANGES.values()
        outcome = ended.code or ("done" if ended.outcome == "answered" else ended.outcome)
        if ended.code and call.name not in _STOPS and self._stopped_s > begun.began_s:
            outcome = "stopped"
        row = _Row(
            key=(call.name, call.context.who, str(structured.get("outcome") or outcome)),
            kind=kind,
            words=_words({**call.arguments, **(_told(structured) if is_change else {})}),
            begun=begun,
            ended_s=time.monotonic(),
            at=datetime.now(UTC),
            facts={} if is_change else self.facts_since(begun, has_failed=bool(ended.error)),
            reason="" if ended.error is None else ended.error.message,
        )
        told = ("objects_moved", "pushed", "others_moved")
        moved = next((structured[name] for name in told if structured.get(name)), None)
        objects = list(moved) if isinstance(moved, list) else []
        with self._lock:
            last = self._row
            is_short = ended.took_s < _SHORT_S and not objects and not is_change
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

    def _on_uncalled(self, tool: str, who: str, facts: Mapping[str, object]) -> None:
        self.flush()
        words = _words(facts)
        self._history.note(words, "done", "", kind=_CHANGES[tool], tool=tool, who=who)

    def _write(self, row: _Row, objects: list[object] | None = None) -> None:
        tool, who, outcome = row.key
        facts: MotionFacts = {**row.facts, "kind": row.kind, "tool": tool, "who": who}
        facts["calls"] = row.calls
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
                one.model_copy(update={"kind": kind})
                for one in found
                if (kind := one.kind or _kind(one.tool)) in (arguments.kind or kind,)
                and (since is None or datetime.fromisoformat(one.at) >= since)
            ][arguments.skip :]
            shown = entries[: arguments.entries]
            return Journal(entries=shown, more=len(entries) - len(shown))

        return Tool(
            name="get_journal",
            title="What was done",
            description="What was done with this robot, newest first: motions (words, outcome, "
            "duration, highest TCP speed, limits that acted); limits, recordings and policies that "
            "changed.",
            arguments=GetJournal,
            result=Journal,
            handler=get_journal,
            read_only=True,
            idempotent=True,
        )


def kind_of(call: IncomingCall) -> Kind | None:
    """Kind of motion or change that a call asks for; None for one that only reads."""
    tool = call.found
    if tool is None or call.context.simulated:
        return None
    if call.name in _STOPS | _LEADS | _OTHERS or tool.simulated_by:
        return _kind(call.name)
    if call.arguments.get("instruction"):
        return "instruction"
    return _CHANGES.get(call.name)


def _kind(tool: str) -> Kind:
    """Kind of a motion; older entries of the history have none."""
    if tool == RUN_TASK:
        return "task"
    if tool in _STOPS:
        return "stop"
    if tool in _LEADS:
        return "lead"
    is_instruction = tool == "set_instruction" or tool.startswith("start_")
    return "instruction" if is_instruction else "tool"


def _told(answer: Mapping[str, object]) -> dict[str, object]:
    started = answer.get("started")
    modules = {
        str(one["module"]): one["started_with"]
        for one in (started if isinstance(started, list) else ())
        if isinstance(one, Mapping) and one.get("started_with")
    }
    # the policy first: words are bounded
    named = {name: modules[name] for name in sorted(modules, key=lambda name: name != "inference")}
    return {**{name: answer[name] for name in _TOLD if answer.get(name)}, **named}


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
