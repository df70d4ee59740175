"""Options that a case has to set: without them nothing can be built, and one rule says so instead
of all that build.
"""

from __future__ import annotations

from rn_testing.case import Case
from rn_testing.rule import NotApplicable, Rule, Violation
from roboneuron import RoboNeuronError, Spec

RULE_ID = "descriptor/case-options"


def missing_options(case: object) -> str:
    """What is to be added to a case that leaves out options without default; empty when nothing is.

    A case that was made without its author's help is left alone: its options are the user's.
    """
    if not isinstance(case, Case) or case.is_automatic:
        return ""
    try:
        model = case.option_model()
    except (RoboNeuronError, Violation, NotApplicable):  # told by the rules about that
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
