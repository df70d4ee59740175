"""Options that a case must set: without them nothing can be built, and one rule reports this
instead of every rule that builds.
"""

from __future__ import annotations

from rn_testing.case import Case
from rn_testing.rule import NotApplicable, Rule, Violation
from roboneuron import RoboNeuronError, Spec

RULE_ID = "descriptor/case-options"


def missing_options(case: object) -> str:
    """Return what must be added to a case that omits options without default; empty if nothing.

    Automatic cases are not checked: their options come from the user.
    """
    if not isinstance(case, Case) or case.is_automatic:
        return ""
    try:
        model = case.option_model()
    except (RoboNeuronError, Violation, NotApplicable):  # reported by the rules for these errors
        return ""
    argument, given = case.given_options()
    fields = (
        {}
        if model is None
        else {field.alias or name: field for name, field in model.model_fields.items()}
    )
    required = {
        name: field for name, field in fields.items() if field.is_required() and name not in given
    }
    if model is None or not required:
        return ""
    whole = {name: repr(value) for name, value in given.items()} | dict.fromkeys(required, "...")
    example = ", ".join(f'"{name}": {value}' for name, value in whole.items())
    meaning = "; ".join(
        f"{name}: {field.description or 'no description'}" for name, field in required.items()
    )
    return (
        f"{model.__name__} requires {', '.join(required)}, which the case does not set. Write "
        f"{type(case).__name__}(spec=..., {argument}={{{example}}}) ({meaning})"
    )


def _check(case: Case[Spec]) -> None:
    if case.is_automatic:
        raise NotApplicable("the options are the user's: --option NAME=VALUE")
    if problem := missing_options(case):
        raise Violation(problem)


RULES: tuple[Rule[Case[Spec]], ...] = (
    Rule(
        id=RULE_ID,
        text="The case sets every option that has no default; until it does, rules that build the "
        "plugin are skipped.",
        source="rn_testing.case.Case",
        check=_check,
    ),
)
"""The rule about the case itself."""
