"""What is known of a tool's arguments at run time only is in their schema, and calls are checked
against it.
"""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import Field

from roboneuron.direct_path.derived import Derived
from roboneuron.errors import InvalidInputError
from roboneuron.server.schema import model_schema, parse
from roboneuron.server.tool import Arguments


class Step(Arguments):
    """Inside of another."""

    duration_s: float = Field(gt=0)


class Move(Arguments):
    """Arguments of a tool."""

    speed: float = Field(default=1.0, ge=0, le=2)
    times: int = Field(default=1, ge=1)
    steps: list[Step] = Field(default_factory=list)
    note: str | None = None


DERIVED = Derived(
    model=Move,
    properties={"speed": {"maximum": 1.5}, "note": {"enum": ["left", "right"]}},
    required=["speed"],
)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "Argument 'speed' is missing."),
        ({"speed": None}, "Argument 'speed' is None"),
        ({"speed": 1.75}, "Argument 'speed' is 1.75, expected up to 1.5."),
        (
            {"speed": 1, "note": "lift"},
            "Argument 'note' is 'lift'. Did you mean 'left'? Choose one of: left, right.",
        ),
        ({"speed": 1, "times": 2}, "The call has no argument 'times'."),
    ],
)
def test_what_is_known_at_run_time_only_is_checked_too(given: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        parse(DERIVED, given)
    assert words in str(caught.value)


def test_a_derived_schema_holds_what_is_used_and_no_other_definition() -> None:
    schema = model_schema(DERIVED)
    assert schema["properties"]["speed"] == {
        "default": 1.0,
        "minimum": 0,
        "maximum": 1.5,
        "type": "number",
    }
    assert schema["required"] == ["speed"]
    assert "$defs" not in schema
    assert model_schema(Derived(model=Move, properties={"steps": {}}))["$defs"].keys() == {"Step"}
