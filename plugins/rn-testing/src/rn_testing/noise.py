"""What a call tells people without being asked: warnings, log entries, text on standard error."""

from __future__ import annotations

import io
import logging
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rn_testing.rule import NotApplicable, require
from roboneuron import RoboNeuronError

CALLS = 5
"""Number of watched calls; a message of each call but the first is too many."""
_HIDDEN = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)
"""Warnings that Python does not show by default; they are for authors."""


class _Collector(logging.Handler):
    def __init__(self, told: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._told = told

    def emit(self, record: logging.LogRecord) -> None:
        self._told.append(f"logs {record.getMessage()[:80]!r}")


@contextmanager
def _watched(told: list[str]) -> Iterator[None]:
    """Append to `told` a sentence part for each message of the block."""
    root, collector, kept = logging.getLogger(), _Collector(told), sys.stderr
    root.addHandler(collector)
    sys.stderr = written = io.StringIO()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            yield
        told += [
            f"warns {str(one.message)[:80]!r}"
            for one in caught
            if not issubclass(one.category, _HIDDEN)
        ]
    finally:
        root.removeHandler(collector)
        if sys.stderr is written:
            sys.stderr = kept
        if text := written.getvalue().strip():
            told.append(f"writes {text[:80]!r} to standard error")


def check_quiet(call: Callable[[], object], what: str) -> None:
    """Raise Violation if every call but the first has a message: what is told each time hides what
    matters, and fills the log.
    """
    for number in range(CALLS):
        told: list[str] = []
        with _watched(told), suppress(NotApplicable, RoboNeuronError):
            call()
        if number and not told:
            return
    require(False, f"each {what} {told[0]}")
