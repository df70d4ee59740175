"""Events of a recorded run by time: tool calls, faults, module health, the gate, instructions."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, TypeVar

from rn_recorder_runs.files import Record
from rn_recorder_runs.timeline import Timeline
from rn_view.diagnostics.event_list import EventList, ShownEvent, add_record, shown_arguments
from rn_view.recordings.playback import Mark
from rn_view.sources.source import chosen_plugin
from roboneuron import ForeignDataError, foreign
from roboneuron.feature import FAULTS

T = TypeVar("T", bound=tuple[Any, ...])
EVENTS, AUDIT = "/roboneuron/events", "/roboneuron/audit"
_STOPS = {"latched": True, "restored": True, "reset": False}
"""Verdicts of the audit that say whether the emergency stop is latched."""
_MARKED = ("call", "fault", "episode_end")
_QUIET = ("get_", "list_", "read_")
"""Prefixes of tools that only read. Only their failures are listed."""
_NS = 1e-9


class RunLog:
    """All events of a run, and the state at a time according to them. Read once.

    Attributes:
        marks: moments to jump to.
    """

    def __init__(self, timeline: Timeline) -> None:
        self._begin_ns = timeline.begin_ns
        self._lines = EventList(kept=None)
        self._health: dict[str, list[tuple[int, str, str]]] = {}
        self._chosen: dict[str, list[tuple[int, str]]] = {}
        self._stops: list[tuple[int, bool, str]] = []
        self._instructions: list[tuple[int, str]] = []
        marks: list[Mark] = []
        for topic in (EVENTS, AUDIT):
            for record in timeline.between(topic, -1, timeline.end_ns):
                with suppress(ValueError, ForeignDataError):  # written by another program
                    told = _decoded(timeline, record)
                    (self._add_event if topic == EVENTS else self._add_verdict)(
                        told, record.log_ns, marks
                    )
        topic = next((topic for topic in timeline.topics if topic.endswith("/predictions")), "")
        for record in timeline.between(topic, -1, timeline.end_ns):
            with suppress(ValueError, ForeignDataError):
                self._add_instruction(_decoded(timeline, record), record.log_ns, marks)
        self.marks = sorted(marks, key=lambda mark: mark.at_s)
        self._sorted = sorted(self._lines.newest(10**9), key=lambda event: event.at_s)
        self._times_ns = [round(event.at_s / _NS) for event in self._sorted]

    def lines(self, at_ns: int) -> list[ShownEvent]:
        """Events up to that time, oldest first."""
        return self._sorted[: bisect_right(self._times_ns, at_ns)]

    def health(self, module: str, at_ns: int) -> tuple[str, str]:
        """Health of a module at that time and its reason, as reported by the server; empty before
        the first report.
        """
        _, health, why = _newest(self._health.get(module, []), at_ns) or (0, "", "")
        return health, why

    def chosen(self, module: str, at_ns: int) -> str:
        """Name of the plugin that a module was started with, such as a backend; empty if not
        recorded.
        """
        return (_newest(self._chosen.get(module, []), at_ns) or (0, ""))[1]

    def stop(self, at_ns: int) -> tuple[bool, str]:
        """Whether the emergency stop was latched at that time, and who pressed it and why."""
        _, is_latched, cause = _newest(self._stops, at_ns) or (0, False, "")
        return is_latched, cause

    def instruction(self, at_ns: int) -> str:
        """Instruction of the policy at that time."""
        return (_newest(self._instructions, at_ns) or (0, ""))[1]

    def _add_event(self, told: Mapping[str, Any], at_ns: int, marks: list[Mark]) -> None:
        what, module = told.get("what"), str(told.get("module", ""))
        text, is_bad = "", False
        if what == "call":
            at_ns = foreign.integer(told.get("at_ns", at_ns), "at_ns")
            is_bad = bool(told.get("error"))
            result = (
                f"{told['error'] if is_bad else 'done'}, "
                f"{foreign.number(told.get('took_ms', 0.0), 'took_ms') / 1e3:.2f} s"
            )
            text = f"{told.get('tool')}({shown_arguments(told.get('arguments'))}): {result}"
        elif what == "health":
            health = str(told.get("health"))
            is_bad = health in FAULTS
            why = str(told.get("error") or told.get("explanation") or "")
            self._health.setdefault(module, []).append((at_ns, health, why if is_bad else ""))
            text = f"{module}: {health}{f': {why}' if is_bad else ''} (was {told.get('before')})"
        elif what == "change":
            named = chosen_plugin(foreign.table(told.get("names") or {}, "names"))
            self._chosen.setdefault(module, []).append((at_ns, named))
            return
        elif what == "fault":
            is_bad, text = True, f"{module}: {told.get('fault')}: {told.get('explanation', '')}"
        elif what == "episode_end":
            text = f"the episode ended: {told.get('outcome', 'unknown')}"
        else:
            text = str(what)
        if what == "call" and not is_bad and str(told.get("tool", "")).startswith(_QUIET):
            return
        kind = {"call": "tool", "episode_end": "run"}.get(str(what), str(what))
        self._lines.add(kind, text, is_bad=is_bad, at_s=at_ns * _NS)
        if is_bad or what in _MARKED:
            self._mark(at_ns, text, marks)

    def _add_verdict(self, told: Mapping[str, object], at_ns: int, marks: list[Mark]) -> None:
        verdict = str(told.get("verdict", ""))
        if not verdict or verdict.endswith("allowed"):
            return  # listed already as a tool call
        add_record(self._lines, {**told, "time_ns": at_ns})
        if verdict in _STOPS:
            self._stops.append(
                (at_ns, _STOPS[verdict], f"{told.get('who', '')}: {told.get('reason', '')}")
            )
            self._mark(at_ns, f"emergency stop {verdict}", marks)
        elif verdict == "refused":
            self._mark(at_ns, f"refused: {told.get('reason', '')}", marks)

    def _add_instruction(self, told: Mapping[str, object], at_ns: int, marks: list[Mark]) -> None:
        instruction = str(told.get("instruction", ""))
        if not self._instructions or self._instructions[-1][1] != instruction:
            self._instructions.append((at_ns, instruction))
            self._mark(at_ns, f"instruction: {instruction}", marks)

    def _mark(self, at_ns: int, text: str, marks: list[Mark]) -> None:
        marks.append(Mark(at_s=max(0.0, (at_ns - self._begin_ns) * _NS), text=text))


def _decoded(timeline: Timeline, record: Record) -> dict[str, Any]:
    what = f"a message on {record.topic}"
    found = foreign.decode_json(timeline.decode(record).data, what, has_constants=True)
    return foreign.table(found, what)


def _newest(rows: list[T], at_ns: int) -> T | None:
    index = bisect_right(rows, at_ns, key=lambda row: int(row[0]))
    return rows[index - 1] if index else None
