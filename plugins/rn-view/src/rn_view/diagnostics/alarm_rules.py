"""Rules that raise alarms: module faults, emergency stops, limits, holds, a fallback policy."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from rn_view.diagnostics.alarms import AlarmBook
from rn_view.diagnostics.module_health import SHORT_S
from roboneuron.feature import StillReason

STOP = "emergency stop"
_OF_LIMITS = {
    "scaled": "Nothing has stopped. If it repeats, slow the policy down or move the target.",
    "held": "The arm holds its position. Check the actions, then give the instruction again.",
    "refused": "The command was not sent. Check the actions of the policy.",
}
_LOOK = "Check the robot. Then a person releases the stop with the command at the top of this page."


class AlarmRules:
    """Raises alarms from events; usable from any thread.

    Args:
        book: stores the alarms.
        clock: monotonic [s].
    """

    def __init__(self, book: AlarmBook, clock: Callable[[], float] = time.monotonic) -> None:
        self._book, self._clock = book, clock
        self._lock = threading.Lock()
        self._silent: dict[str, tuple[float, float, StillReason]] = {}
        self._fallbacks = 0

    def on_health(self, module: str, health: str, reason: StillReason | None = None) -> None:
        """Handle a change of health. "silent" raises an alarm once it has lasted for a second,
        because reports may be late on a busy machine.

        Args:
            module: its kind.
            health: its new health.
            reason: what a module with a fault reports, see `ModuleView.still_reason`.
        """
        with self._lock:
            was_silent = self._silent.pop(module, None)
            if health == "silent" and reason is not None:
                self._silent[module] = was_silent or (self._clock(), time.time(), reason)
                return
        if reason is not None:
            self._book.add(module, health, reason.message, reason.hint)
        elif health in ("ok", "stopped"):
            self._book.end(module)

    def poll(self) -> None:
        """Raise alarms for modules that have been silent long enough. Call it a few times a
        second.
        """
        now_s = self._clock()
        with self._lock:
            due = {
                module: told for module, told in self._silent.items() if now_s - told[0] >= SHORT_S
            }
            for module in due:
                del self._silent[module]
        for module, (_, at_s, reason) in due.items():
            self._book.add(module, "silent", reason.message, reason.hint, at_s=at_s)

    def on_fault(self, module: str, what: str, facts: Mapping[str, object]) -> None:
        """Listener of `Events.fault`: faults that are not the health of a module."""
        cause = str(facts.get("explanation", "")) or what
        self._book.add(module, what, cause, "See the server's log and the tab 'Events'.")

    def on_record(self, record: Mapping[str, Any]) -> None:
        """Handle an audit record, also one of another process. Each counts once, also across
        restarts.
        """
        at_ns = int(record.get("time_ns", 0))
        if at_ns <= self._book.seen_ns:
            return
        self._book.seen_ns = at_ns
        verdict, who, at_s = record.get("verdict"), str(record.get("who", "")), at_ns / 1e9
        reason, rule = str(record.get("reason", "")), str(record.get("rule", ""))
        if verdict in ("latched", "restored"):
            cause = f"{who}: {reason}".rstrip(": ")
            word = "pressed" if verdict == "latched" else "its file was deleted; written again"
            self._book.add(STOP, word, cause, _LOOK, at_s=at_s)
        elif record.get("tool") == "reset_emergency_stop" and verdict == "allowed":
            self._book.end(STOP, at_s)
        elif who == "control" and verdict in _OF_LIMITS:
            word = "limit" if verdict == "scaled" else "hold" if verdict == "held" else "refusal"
            self._book.add(
                "control",
                f"{word}: {rule}",
                reason,
                _OF_LIMITS[str(verdict)],
                is_warning=verdict == "scaled",
                at_s=at_s,
            )

    def on_metrics(self, metrics: Mapping[str, str]) -> None:
        """Handle metrics of the inference module: its fallback policy may have taken over."""
        try:
            count = int(metrics.get("fallback.count", 0))
        except ValueError:
            return
        if count > self._fallbacks:
            acting, reason = metrics.get("fallback.acting", ""), metrics.get("fallback.reason", "")
            self._book.add(
                "inference",
                "fallback",
                f"{acting or 'The second policy'} is in use: {reason or 'the first was late'}",
                "Check the first policy's machine and network. It takes over again by itself.",
                is_warning=True,
            )
        self._fallbacks = count
