"""Rules that raise alarms: module faults, emergency stops, limits, holds, a fallback policy."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from rn_view.diagnostics.alarms import AlarmBook
from rn_view.diagnostics.module_health import SHORT_S
from roboneuron.feature import EXPLANATIONS, FAULTS

STOP = "emergency stop"
_ADVICE = {
    "silent": "If it lasts, stop the module and start it again. The machine may be overloaded.",
    "stuck": "Stop the module and start it again.",
    "stalled": "See what it waits for (table of modules), then stop it and start it again.",
    "exited": "Read its log (roboneuron logs), then start it again.",
    "failing": "Do what the message says. The module continues once the cause is gone.",
}
_OF_LIMITS = {
    "scaled": "Nothing has stopped. If it repeats, slow the policy down or move the target.",
    "held": "The arm holds its position. Check the actions, then give the instruction again.",
    "refused": "The command was not sent. Check the actions of the policy.",
}
_LOOK = "Check the robot. Then a person releases the stop: roboneuron estop --reset."


class AlarmRules:
    """Raises alarms from events; usable from any thread.

    Args:
        book: stores the alarms.
        clock: monotonic [s].
    """

    def __init__(self, book: AlarmBook, clock: Callable[[], float] = time.monotonic) -> None:
        self._book, self._clock = book, clock
        self._lock = threading.Lock()
        self._silent: dict[str, tuple[float, float, str]] = {}
        self._fallbacks = 0

    def on_health(self, module: str, health: str, why: str, hint: str = "") -> None:
        """Handle a change of health. "silent" raises an alarm once it has lasted for a second,
        because reports may be late on a busy machine.
        """
        with self._lock:
            was_silent = self._silent.pop(module, None)
            if health == "silent":
                since_s = was_silent or (self._clock(), time.time(), why)
                self._silent[module] = since_s
                return
        if health in FAULTS:
            meaning = EXPLANATIONS[health]
            cause = why or f"The module: {meaning}."
            advice = hint or _ADVICE.get(health, "See its log.")
            self._book.add(module, health, cause, advice)
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
        for module, (_, at_s, why) in due.items():
            cause = why or "The module is alive, but does not report."
            self._book.add(module, "silent", cause, _ADVICE["silent"], at_s=at_s)

    def on_fault(self, module: str, what: str, facts: Mapping[str, object]) -> None:
        """Listener of `Events.fault`: faults that are not the health of a module."""
        cause = str(facts.get("explanation", "")) or what
        self._book.add(module, what, cause, "See the server's log and the list 'What happened'.")

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
