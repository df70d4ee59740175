"""Health of modules for the page, debounced against late reports on a busy machine."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from rn_view.diagnostics.event_list import EventList, ShownEvent
from rn_view.sources.source import ModuleRow
from roboneuron.feature import FAULTS

SHORT_S = 1.0
"""A change between "ok" and "silent" is shown once it has lasted this long. On a busy machine a
status may be a few tenths of a second late. Only the display waits; the supervisor does not.
"""
JOINED_S = 5.0
"""Health changes of a module within this time of each other share one line."""
_FLICKER = {"ok", "silent"}


@dataclass(slots=True)
class _Shown:
    """Row of a module on the page.

    Attributes:
        row: the row shown last.
        since_s: start of a change that is not shown yet [s]; None when there is none.
    """

    row: ModuleRow
    since_s: float | None = None


class SteadyHealth:
    """Debounces health in the table of modules. For one thread."""

    def __init__(self) -> None:
        self._shown: dict[str, _Shown] = {}

    def rows(self, rows: Iterable[ModuleRow], now_s: float) -> tuple[ModuleRow, ...]:
        """Rows to show at `now_s` [s], a time that jumps back when a recording is rewound."""
        return tuple(self._row(row, now_s) for row in rows)

    def _row(self, row: ModuleRow, now_s: float) -> ModuleRow:
        shown = self._shown.setdefault(row.kind, _Shown(row))
        health = shown.row.health
        if row.health == health or {row.health, health} != _FLICKER:
            shown.row, shown.since_s = row, None
            return row
        if shown.since_s is None:
            shown.since_s = now_s
        if 0.0 <= now_s - shown.since_s < SHORT_S:
            return replace(row, health=health, text=shown.row.text)
        shown.row, shown.since_s = row, None
        return row


@dataclass(slots=True)
class _Trouble:
    """A series of faults of one module.

    Attributes:
        line: their common line in the list.
        first_s, last_s: times of the first and the newest change [s].
        counts: number of changes to each fault.
    """

    line: ShownEvent
    first_s: float
    last_s: float
    counts: Counter[str] = field(default_factory=Counter)

    def is_short(self) -> bool:
        """Whether it has been over within `SHORT_S`."""
        return self.last_s - self.first_s < SHORT_S

    def summary(self) -> str:
        """Number of faults and the time that they span."""
        counts = ", ".join(f"{fault} {_times(count)}" for fault, count in self.counts.items())
        return f"{counts} in {max(1.0, self.last_s - self.first_s):.0f} s"


def _times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


class HealthLines:
    """Adds faults of modules and their ends to the list of events. Changes within `JOINED_S` of
    each other share one line with their counts. A silence shorter than `SHORT_S` leaves none, nor
    does a module that starts or stops, because the call that did it has one. Usable from any
    thread.

    Args:
        events: receives the lines.
    """

    def __init__(self, events: EventList) -> None:
        self._events = events
        self._lock = threading.Lock()
        self._troubles: dict[str, _Trouble] = {}

    def add(self, module: str, health: str, *, before: str, why: str = "") -> None:
        """Add a change of `module` from `before` to `health`, made now."""
        is_bad = health in FAULTS
        text = f"{module}: {health}{f': {why}' if why else ''}"
        with self._lock:
            trouble = self._troubles.get(module)
            at_s = self._events.now_s()
            if trouble is None or not 0.0 <= at_s - trouble.last_s <= JOINED_S:
                if not is_bad and before not in FAULTS:
                    return
                line = self._events.add(
                    "health", f"{text} (was {before})", is_bad=is_bad, at_s=at_s
                )
                if is_bad:
                    counts = Counter({health: 1})
                    self._troubles[module] = _Trouble(line, at_s, at_s, counts)
                return
            trouble.last_s = at_s
            if health == "ok" and set(trouble.counts) == {"silent"} and trouble.is_short():
                self._events.remove(trouble.line)
                del self._troubles[module]
                return
            if is_bad:
                trouble.counts[health] += 1
            trouble.line = self._events.add(
                "health",
                f"{text} ({trouble.summary()})",
                is_bad=is_bad,
                instead_of=trouble.line,
            )
