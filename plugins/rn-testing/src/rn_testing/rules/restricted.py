"""The rule of restricted options, for every kind."""

from __future__ import annotations

from typing import Any

from rn_testing.cases import Case
from rn_testing.rule import NotApplicable, Rule, require
from roboneuron.plugins.loading import load_options_model
from roboneuron.plugins.restricted import unmarked_options
from roboneuron.plugins.specs import DriverSpec, RobotSpec, Spec


def _check_restricted_options(case: Case[Any]) -> None:
    spec = case.spec
    specs: tuple[Spec | DriverSpec, ...] = (spec, *spec.drivers) if isinstance(spec, RobotSpec) else (spec,)
    models = [model for part in specs if (model := load_options_model(part)) is not None]
    if not models:
        raise NotApplicable("there are no options")
    unmarked = [option for model in models for option in unmarked_options(model)]
    require(
        not unmarked,
        f"{', '.join(unmarked)} may name a host, a file, a command or a secret, by type or name: mark it with "
        "ConfigurationOnly(), or with AgentMaySet() when it does not",
    )


RULES: tuple[Rule[Case[Any]], ...] = (
    Rule(
        id="descriptor/restricted-options-marked",
        text="Options that look as if they name hosts, files, commands or secrets say whether agents may set them.",
        source="roboneuron.plugins.restricted",
        check=_check_restricted_options,
    ),
)
"""Rules that apply to every kind."""
