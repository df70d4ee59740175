"""Rules as data: an id, a sentence, the place that states it, and the check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Generic, TypeAlias, TypeVar

CaseT = TypeVar("CaseT")


class Violation(AssertionError):
    """A rule is violated; the message tells got and expected."""


class NotApplicable(Exception):
    """A rule does not apply to a case (a backend without state, a runtime without a request)."""


class RuleVerdict(StrEnum):
    """Result of one rule for one case."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, kw_only=True, slots=True)
class Rule(Generic[CaseT]):
    """A requirement for every plugin of a kind.

    Attributes:
        id: "<subject>/<what>", stable, unique over all rules.
        text: one sentence that holds for every good plugin.
        source: dotted name whose docstring states it.
        check: raises Violation if the rule is violated, NotApplicable if it does not apply.
    """

    id: str
    text: str
    source: str
    check: Callable[[CaseT], None]


AnyRule: TypeAlias = Rule[Any]
"""A rule for any kind of case."""


def require(condition: bool, message: str) -> None:
    """Raise Violation with `message` unless `condition` is true."""
    if not condition:
        raise Violation(message)
