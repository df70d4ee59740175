"""Rules as data: an id, what must hold, where that is stated, and the check that decides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Generic, TypeAlias, TypeVar

CaseT = TypeVar("CaseT")


class Violation(AssertionError):
    """A rule does not hold; the message says what came and what was expected."""


class NotApplicable(Exception):
    """A rule says nothing about this case (a backend without state, a runtime without a request to
    try).
    """


class RuleVerdict(StrEnum):
    """Outcome of one rule for one case."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, kw_only=True, slots=True)
class Rule(Generic[CaseT]):
    """One thing that every plugin of a kind must do.

    Attributes:
        id: "<subject>/<what>", stable, unique over all rules.
        text: one sentence that holds for every good plugin.
        source: dotted name whose docstring states it.
        check: raises Violation when it does not hold, NotApplicable when it says nothing about the
            case.
    """

    id: str
    text: str
    source: str
    check: Callable[[CaseT], None]


AnyRule: TypeAlias = Rule[Any]
"""A rule of one kind of cases among those of others."""


def require(condition: bool, message: str) -> None:
    """Raise Violation with `message` unless `condition` holds."""
    if not condition:
        raise Violation(message)
