"""Rules as data: an id, what must hold, where that is stated, and the check that decides."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Generic, TypeAlias, TypeVar

from rn_testing.deadline import Overdue, run_bounded

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


@dataclass(frozen=True, kw_only=True, slots=True)
class RuleResult:
    """What came of one rule.

    Attributes:
        rule: the rule's id.
        verdict: passed, failed or skipped.
        detail: why it failed or was skipped; empty when passed.
        traceback: of an unexpected exception; empty otherwise.
    """

    rule: str
    verdict: RuleVerdict
    detail: str = ""
    traceback: str = ""


def verify(rule: Rule[CaseT], case: CaseT) -> RuleResult:
    """Run one rule, every call bounded; what the plugin raises and the rule does not expect is a
    failure.

    Where the case lacks options that its plugin requires, the rule about that fails; those that
    build it are skipped.
    """
    from rn_testing.case_options import RULE_ID, missing_options  # which needs this module

    if not rule.id.startswith("descriptor/") and missing_options(case):
        return RuleResult(
            rule=rule.id,
            verdict=RuleVerdict.SKIPPED,
            detail=f"the case lacks options, see {RULE_ID}",
        )
    try:
        run_bounded(lambda: rule.check(case))
    except Overdue as overdue:
        return RuleResult(rule=rule.id, verdict=RuleVerdict.FAILED, detail=str(overdue))
    except NotApplicable as reason:
        return RuleResult(rule=rule.id, verdict=RuleVerdict.SKIPPED, detail=str(reason))
    except Violation as violation:
        return RuleResult(rule=rule.id, verdict=RuleVerdict.FAILED, detail=str(violation))
    except Exception as error:  # the border to a plugin's own code
        detail = f"raised {type(error).__name__}: {error}"
        return RuleResult(
            rule=rule.id,
            verdict=RuleVerdict.FAILED,
            detail=detail,
            traceback=traceback.format_exc(),
        )
    return RuleResult(rule=rule.id, verdict=RuleVerdict.PASSED)


def require(condition: bool, message: str) -> None:
    """Raise Violation with `message` unless `condition` holds."""
    if not condition:
        raise Violation(message)
