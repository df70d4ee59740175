"""Verification of one rule for one case."""

from __future__ import annotations

import traceback
from dataclasses import dataclass

from rn_testing.case_options import RULE_ID, missing_options
from rn_testing.deadline import Overdue, run_bounded
from rn_testing.rule import CaseT, NotApplicable, Rule, RuleVerdict, Violation


@dataclass(frozen=True, kw_only=True, slots=True)
class RuleResult:
    """Result of one rule.

    Attributes:
        rule: the rule's id.
        verdict: passed, failed or skipped.
        detail: why it failed or was skipped; empty if passed.
        traceback: traceback of an unexpected exception; empty otherwise.
    """

    rule: str
    verdict: RuleVerdict
    detail: str = ""
    traceback: str = ""


def verify(rule: Rule[CaseT], case: CaseT) -> RuleResult:
    """Check one rule with every call bounded; an unexpected exception of the plugin is a failure.

    If the case lacks required options, the rule about them fails, and rules that build it are
    skipped.
    """
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
    except Exception as error:  # the border to a plugin's code
        detail = f"raised {type(error).__name__}: {error}"
        return RuleResult(
            rule=rule.id,
            verdict=RuleVerdict.FAILED,
            detail=detail,
            traceback=traceback.format_exc(),
        )
    return RuleResult(rule=rule.id, verdict=RuleVerdict.PASSED)
