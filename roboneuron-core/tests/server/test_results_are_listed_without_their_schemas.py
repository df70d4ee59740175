"""A result in tools/list matches its JSON schema, whether instantiated or not."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field, computed_field, field_serializer

from roboneuron import Result
from roboneuron.server.schema import listed_output, model_schema


class _Word(StrEnum):
    A = "a"


class _Part(Result):
    value: int


class _Known(Result):
    text: str
    number: float = Field(description="with a description")
    several: list[_Part]
    pair: tuple[float, float]
    table: dict[str, int]
    part: _Part
    word: Literal["a", "b"]
    maybe: list[int] | None = None
    either: str | _Part = ""


class _Enumeration(Result):
    word: _Word


class _Anything(Result):
    value: Any
    values: set[int]


class _Bounded(Result):
    values: Annotated[list[int], Field(max_length=3)]


class _Hidden(Result):
    shown: int
    hidden: int = Field(default=0, exclude=True)


class _Renamed(Result):
    value: int = Field(alias="other")


class _Serialized(Result):
    value: int

    @field_serializer("value")
    def listed(self, value: int) -> list[int]:
        """As a list."""
        return [value]


class _Told(Result):
    value: int = Field(json_schema_extra={"type": "array"})


class _Computed(Result):
    value: int

    @computed_field  # type: ignore[prop-decorator]
    @property
    def values(self) -> list[int]:
        """The value, as a list."""
        return [self.value]


MODELS = (
    _Known,
    _Enumeration,
    _Anything,
    _Bounded,
    _Hidden,
    _Renamed,
    _Serialized,
    _Told,
    _Computed,
)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_fields_are_listed_as_the_schema_has_them(model: type[Result]) -> None:
    listed = listed_output(model)
    entries = model_schema(model, result=True)["properties"]
    assert listed["properties"].keys() == entries.keys()
    for name, entry in entries.items():
        kind = "object" if "$ref" in entry else entry.get("type")
        assert listed["properties"][name] == (
            {"type": kind} if kind in ("object", "array") else {}
        ), name


def test_no_schema_is_made_of_a_result_with_fields_of_known_types() -> None:
    class Fresh(Result):
        several: list[int]
        part: _Part

    assert listed_output(Fresh) == {
        "type": "object",
        "properties": {"several": {"type": "array"}, "part": {"type": "object"}},
    }
    assert not Fresh.__pydantic_complete__
