"""The rule of restricted options, for every kind."""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

from pydantic import BaseModel

from rn_testing.cases import Case
from rn_testing.rule import NotApplicable, Rule, require
from roboneuron import DriverSpec, RobotSpec, Spec
from roboneuron.feature import loading
from roboneuron.selection.restricted import OptionAccess


def unmarked_options(model: type[BaseModel]) -> list[str]:
    """Options that look restricted and have neither mark, including those of nested tables, as
    `Model.option`.
    """
    found, pending, seen = [], [model], {model}
    while pending:
        table = pending.pop(0)
        for name, field in table.model_fields.items():
            access = OptionAccess.of(name, field)
            if access.looks_restricted and access.mark is None:
                found.append(f"{table.__name__}.{name}")
            inner = [part for part in _tables(field.annotation) if part not in seen]
            pending += inner
            seen.update(inner)
    return found


def _tables(annotation: object) -> Iterator[type[BaseModel]]:
    """The tables in a type, at any depth."""
    annotation = getattr(annotation, "__value__", annotation)  # a `type` statement of Python 3.12
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _tables(part)


def _check_restricted_options(case: Case[Spec]) -> None:
    spec = case.spec
    specs: tuple[Spec | DriverSpec, ...] = (
        (spec, *spec.drivers) if isinstance(spec, RobotSpec) else (spec,)
    )
    models = [model for part in specs if (model := loading.load_options_model(part)) is not None]
    if not models:
        raise NotApplicable("there are no options")
    unmarked = [option for model in models for option in unmarked_options(model)]
    require(
        not unmarked,
        f"{', '.join(unmarked)} may name a host, a file, a command or a secret, by type or name: "
        "mark it with "
        "ConfigurationOnly(), or with AgentMaySet() when it does not",
    )


RULES: tuple[Rule[Case[Spec]], ...] = (
    Rule(
        id="descriptor/restricted-options-marked",
        text="Options that look as if they name hosts, files, commands or secrets say whether "
        "agents may set them.",
        source="roboneuron.selection.restricted",
        check=_check_restricted_options,
    ),
)
"""Rules for every kind."""
