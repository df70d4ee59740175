"""Descriptors with one mistake each."""

from __future__ import annotations

from pathlib import Path

from mutation import Mutant
from pydantic import BaseModel, ConfigDict, Field

not_callable = "no class"


class OpenOptions(BaseModel):
    delta_m: float = Field(default=0.001, description="how far")


class BareOptions(BaseModel):
    model_config = ConfigDict(extra="forbid")

    delta_m: float = 0.001


class Demanding(BaseModel):
    """Cannot be built without a topic."""

    model_config = ConfigDict(extra="forbid")

    topic: str = Field(description="topic of the images")


class BadDefaults(BaseModel):
    model_config = ConfigDict(extra="forbid")

    delta_m: float = Field(default=-1.0, gt=0, description="how far")


class UnmarkedOptions(BaseModel):
    model_config = ConfigDict(extra="forbid")

    weights: Path = Field(default=Path("w"), description="where they are")


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid")

    server_url: str = Field(default="", description="who answers")


class UnmarkedTable(BaseModel):
    model_config = ConfigDict(extra="forbid")

    remote: Table = Field(default=Table(), description="who answers")


def but(rule, words="", **spec):
    return Mutant(rule=f"descriptor/{rule}", spec=spec, words=words)


MUTANTS: dict[str, Mutant] = {
    "name_with_blanks": but("well-formed", name="Not A Name"),
    "cameras_in_a_list": but("well-formed", cameras=["primary"]),
    "summary_of_two_lines": but("well-formed", summary="one\ntwo"),
    "target_without_attribute": but("well-formed", target="mutants_backend"),
    "another_contract": but("compatible", contract=99),
    "summary_too_long": but("summary-fits", summary="long " * 40),
    "target_not_callable": but("target-callable", target="mutants_descriptors:not_callable"),
    "target_absent": but("target-callable", target="mutants_descriptors:Absent"),
    "target_module_absent": but("target-callable", target="no_such_module:Absent"),
    "wrong_arguments": Mutant(
        rule="descriptor/target-callable", target=type("Wrong", (), {"__init__": lambda self: None})
    ),
    "options_open": but("options-closed", config="mutants_descriptors:OpenOptions"),
    "options_no_model": but("options-closed", config="mutants_descriptors:not_callable"),
    "options_without_description": but(
        "options-described", config="mutants_descriptors:BareOptions"
    ),
    "defaults_against_their_own_bounds": but(
        "options-default", config="mutants_descriptors:BadDefaults"
    ),
    "restricted_unmarked": but(
        "restricted-options-marked", config="mutants_descriptors:UnmarkedOptions"
    ),
    "restricted_unmarked_in_a_table": but(
        "restricted-options-marked", config="mutants_descriptors:UnmarkedTable"
    ),
    "case_absent": but("case-found", case="mutants_descriptors:absent"),
    "case_not_callable": but("case-found", case="mutants_descriptors:not_callable"),
    "case_without_what_is_required": but("case-options", config="mutants_descriptors:Demanding"),
}


def __getattr__(name):
    if name not in MUTANTS or MUTANTS[name].target is None:
        raise AttributeError(name)
    return MUTANTS[name].target
