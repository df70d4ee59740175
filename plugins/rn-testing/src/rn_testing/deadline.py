"""Time limits for calls into a plugin: a call that hangs fails its rule, and the run continues."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from time import monotonic  # kept when a rule moves the clocks
from typing import TypeVar, cast

P = TypeVar("P")
T = TypeVar("T")

CALL_LIMIT_S = 20.0
"""Limit of a call without its own limit in CALL_LIMITS_S."""
CALL_LIMITS_S: Mapping[str, float] = {
    "constructor": 5.0,
    "load": 300.0,
    "open": 60.0,
    # of a feature: the server starts one after the other and does not answer meanwhile
    "start": 10.0,
    "reset": 5.0,
    "close": 5.0,  # the supervisor kills a module that takes longer
    "abort": 2.0,
    "hold": 2.0,
    "send": 2.0,
}
"""Limit of one call by method name [s]; a case's `limits_s` take precedence. Generous, because
other rules check the speed.
"""
RULE_LIMIT_S = 600.0
"""Limit of a whole rule, for hangs outside of a plugin's methods (a factory of the case, an
import).
"""


class Overdue(Exception):
    """A call did not return in time; the message names it and its limit."""


class _Watch:
    """The current call in the watched thread."""

    def __init__(self) -> None:
        # name, limit, start; replaced as a whole
        self._call: tuple[str, float, float] | None = None

    def begin(self, name: str, limit_s: float) -> None:
        self._call = (name, limit_s, monotonic())

    def end(self) -> None:
        self._call = None

    def check(self) -> None:
        call = self._call
        if call is not None and monotonic() - call[2] > call[1]:
            raise Overdue(f"{call[0]} did not return within {call[1]:g} s")


_watch: ContextVar[_Watch | None] = ContextVar("watched_calls", default=None)


class _Bounded:
    """Proxy of a plugin's object; reports the start and end of each method call to the thread's
    watch.
    """

    def __init__(self, subject: object, limits_s: Mapping[str, float]) -> None:
        self._subject = subject
        self._limits_s = {**CALL_LIMITS_S, **limits_s}

    def __getattr__(self, name: str) -> object:
        value = getattr(self._subject, name)
        if not callable(value):
            return value
        limit_s = self._limits_s.get(name, CALL_LIMIT_S)
        return lambda *arguments, **named: call_bounded(
            name, limit_s, lambda: value(*arguments, **named)
        )


def bounded(subject: P, limits_s: Mapping[str, float]) -> P:
    """Wrap `subject` so that its method calls are bounded inside `run_bounded`."""
    return cast(P, _Bounded(subject, limits_s))


def call_bounded(name: str, limit_s: float, work: Callable[[], T]) -> T:
    """Return the result of `work`, bounded like a method called `name`."""
    watch = _watch.get()
    if watch is None:
        return work()
    watch.begin(name, limit_s)
    try:
        return work()
    finally:
        watch.end()


def unbounded(subject: P) -> P:
    """Return the object given to `bounded`; any other object unchanged."""
    return cast(P, subject._subject) if isinstance(subject, _Bounded) else subject


def run_bounded(work: Callable[[], T]) -> T:
    """Return the result of `work`, executed in its own thread as in a module; raises its errors.

    Raises:
        Overdue: a bounded call or the whole hangs. The thread is a daemon and is abandoned.
    """
    watch = _Watch()
    outcome: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        _watch.set(watch)
        try:
            outcome.append(work())
        except BaseException as error:  # raised in the caller below
            errors.append(error)

    thread = threading.Thread(target=run, name="contract-rule", daemon=True)
    begun_s = monotonic()
    thread.start()
    while thread.is_alive():
        thread.join(0.05)
        watch.check()
        if monotonic() - begun_s > RULE_LIMIT_S:
            raise Overdue(f"the rule did not end within {RULE_LIMIT_S:g} s")
    if errors:
        raise errors[0]
    return outcome[0]
