"""Rules of every descriptor: it is correct, and the names in it can be imported and called."""

from __future__ import annotations

import inspect

from pydantic import BaseModel, ValidationError

from rn_testing import case_options
from rn_testing.cases import Case
from rn_testing.rule import NotApplicable, Rule, Violation, require
from roboneuron import CONTRACT_VERSION, DriverSpec, RobotSpec, Spec
from roboneuron.command import descriptor
from roboneuron.feature import loading

AnyCase = Case[Spec]

SUMMARY_LENGTH = 120
"""Maximum length of a summary in characters, for tables and agents."""


def _check_well_formed(case: AnyCase) -> None:
    descriptor.check_spec(case.spec, type(case.spec))


def _check_compatible(case: AnyCase) -> None:
    written = case.spec.contract
    require(
        written == CONTRACT_VERSION,
        f"written for contract {written}, this core has {CONTRACT_VERSION}",
    )


def _check_summary(case: AnyCase) -> None:
    summary = case.spec.summary
    require(
        len(summary) <= SUMMARY_LENGTH,
        f"the summary has {len(summary)} characters, at most {SUMMARY_LENGTH}",
    )


def _described(case: AnyCase) -> tuple[Spec | DriverSpec, ...]:
    """The descriptor; for a robot also its drivers whose requirements are met or that the case
    tests.
    """
    spec = case.spec
    return (spec, *spec.drivers) if isinstance(spec, RobotSpec) else (spec,)


def _check_target(case: AnyCase) -> None:
    target = loading.load_target(case.spec)
    require(
        callable(target),
        f"`target` {case.spec.target!r} names {target!r}, expected a class or function",
    )
    positional, named = case.arguments()
    try:
        inspect.signature(target).bind(*positional, **named)  # type: ignore[arg-type]
    except TypeError as error:
        words = [
            *(["config"] if positional else []),
            *("..." for _ in positional[1:]),
            *(f"{n}=..." for n in named),
        ]
        call = f"target({', '.join(words)})"
        raise Violation(
            f"`target` {case.spec.target!r} cannot be called as {call}: {error}"
        ) from error


def _options_models(case: AnyCase) -> list[type[BaseModel]]:
    """Models of the options. Raises NotApplicable if there are none."""
    found = [loading.load_options_model(spec) for spec in _described(case)]
    models = [model for model in found if model is not None]
    if not models:
        raise NotApplicable("there are no options")
    return models


def _check_config(case: AnyCase) -> None:
    for model in _options_models(case):
        extra = model.model_config.get("extra")
        require(
            extra == "forbid",
            f'{model.__name__} has extra={extra!r}, expected ConfigDict(extra="forbid")',
        )


def _check_option_descriptions(case: AnyCase) -> None:
    for model in _options_models(case):
        bare = [name for name, option in model.model_fields.items() if not option.description]
        require(not bare, f"{model.__name__} has options without description: {', '.join(bare)}")


def _check_defaults(case: AnyCase) -> None:
    for model in _options_models(case):
        if any(option.is_required() for option in model.model_fields.values()):
            continue  # nothing to test without the user's own values
        defaults = {
            name: option.get_default(call_default_factory=True)
            for name, option in model.model_fields.items()
        }
        try:
            model.model_validate(defaults)
        except ValidationError as error:
            # A problem without a location concerns options that belong together: the user must set
            # some of them.
            wrong = [f"{p['loc'][0]}: {p['msg']}" for p in error.errors() if p["loc"]]
            require(not wrong, f"{model.__name__} refuses its own defaults: {'; '.join(wrong)}")


def _check_case(case: AnyCase) -> None:
    if case.spec.case is None:
        raise NotApplicable("it names no case")
    function = loading.load_attribute(case.spec.case, f"`case` of {case.spec.name!r}")
    require(
        callable(function), f"`case` {case.spec.case!r} names {function!r}, expected a function"
    )


RULES: tuple[Rule[AnyCase], ...] = (
    Rule(
        id="descriptor/well-formed",
        text="Names, targets and field types are those of its descriptor class.",
        source="roboneuron.plugins.specs",
        check=_check_well_formed,
    ),
    Rule(
        id="descriptor/compatible",
        text="It is written for the contract of this core.",
        source="roboneuron.plugins.specs.CONTRACT_VERSION",
        check=_check_compatible,
    ),
    Rule(
        id="descriptor/summary-fits",
        text=f"The summary is one line of at most {SUMMARY_LENGTH} characters.",
        source="roboneuron.plugins.specs.Spec",
        check=_check_summary,
    ),
    Rule(
        id="descriptor/target-callable",
        text="`target` can be imported and called with the arguments that the protocol of its "
        "kind names.",
        source="roboneuron.contract.protocols",
        check=_check_target,
    ),
    Rule(
        id="descriptor/options-closed",
        text="`config` names a pydantic model that forbids unknown keys.",
        source="roboneuron.plugins.specs.Spec",
        check=_check_config,
    ),
    Rule(
        id="descriptor/options-described",
        text="Every option has a description; users and agents read it.",
        source="roboneuron.plugins.specs.Spec",
        check=_check_option_descriptions,
    ),
    Rule(
        id="descriptor/options-default",
        text="The defaults of the options are within their bounds.",
        source="roboneuron.plugins.specs.Spec",
        check=_check_defaults,
    ),
    Rule(
        id="descriptor/case-found",
        text="`case`, if any, can be imported and called.",
        source="roboneuron.plugins.specs.Spec",
        check=_check_case,
    ),
    *case_options.RULES,
)
"""Rules for every kind."""
