"""Arguments have JSON's types: nothing is converted, and refusals name the argument."""

from __future__ import annotations

from typing import Any, Literal

import pytest
from pydantic import Field

from roboneuron.errors import InvalidInputError
from roboneuron.server.schema import parse
from roboneuron.server.tool import Arguments


class Step(Arguments):
    """A nested model."""

    duration_s: float = Field(gt=0)


class Move(Arguments):
    """Arguments of a tool."""

    speed: float = Field(default=1.0, ge=0, le=2)
    times: int = Field(default=1, ge=1)
    form: Literal["jpeg", "png"] = "jpeg"
    is_slow: bool = False
    steps: list[Step] = Field(default_factory=list)
    note: str | None = None
    box_m: tuple[float, float] = (0.0, 1.0)


@pytest.mark.parametrize(
    ("given", "words", "path"),
    [
        ({"speed": True}, "Argument 'speed' is True, expected a valid number", "speed"),
        ({"speed": "1"}, "Argument 'speed' is '1', expected a valid number", "speed"),
        ({"speed": float("nan")}, "Argument 'speed' is nan, expected a finite number", "speed"),
        ({"speed": float("inf")}, "Argument 'speed' is inf, expected a finite number", "speed"),
        ({"speed": 3}, "Argument 'speed' is 3, expected less than or equal to 2", "speed"),
        ({"times": True}, "Argument 'times' is True, expected a valid integer", "times"),
        ({"times": 1.5}, "Argument 'times' is 1.5, expected a valid integer", "times"),
        ({"is_slow": 1}, "Argument 'is_slow' is 1, expected a valid boolean", "is_slow"),
        (
            {"form": "pgn"},
            "Argument 'form' is 'pgn'. Did you mean 'png'? Choose one of: jpeg, png.",
            "form",
        ),
        ({"note": 5}, "Argument 'note' is 5, expected a valid string", "note"),
        ({"sped": 1}, "The call has no argument 'sped'. Did you mean 'speed'?", "sped"),
        (
            {"steps": [{"duration": 1}]},
            "Argument 'steps.0' has no argument 'duration'. Did you mean 'du",
            "duration",
        ),
        ({"steps": [{}]}, "Argument 'steps.0.duration_s' is missing.", "steps.0.duration_s"),
        ({"steps": {}}, "Argument 'steps' is {}, expected a valid array", "steps"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(given: dict[str, Any], words: str, path: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        parse(Move, given)
    assert words in str(caught.value)
    assert caught.value.path == path


def test_a_list_is_a_tuple_where_the_model_has_one() -> None:
    assert parse(Move, {"box_m": [1, 2.5]}).box_m == (1.0, 2.5)
    for wrong in ([1], [1, True], "12"):
        with pytest.raises(InvalidInputError, match="box_m"):
            parse(Move, {"box_m": wrong})


def test_what_is_no_text_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="no Unicode"):
        parse(Move, {"note": "\ud800"})


def test_an_integer_may_be_written_with_a_point_and_null_is_omitted() -> None:
    assert parse(Move, {"times": 2.0, "speed": 1, "note": None}) == Move(times=2, speed=1.0)


def test_arguments_that_are_nested_too_deeply_are_refused_and_no_fault_of_the_server() -> None:
    nested: dict[str, Any] = {}
    for _ in range(5000):
        nested = {"a": nested}
    with pytest.raises(InvalidInputError, match="nested too deeply"):
        parse(Move, {"steps": [nested]})
