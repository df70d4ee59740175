"""Models whose JSON schemas are determined at run time, for example from a ROS interface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from pydantic import BaseModel
from pydantic.json_schema import JsonSchemaValue

from roboneuron.errors import InvalidInputError
from roboneuron.server.schema import Shape

M_co = TypeVar("M_co", bound=BaseModel, covariant=True)


@dataclass(frozen=True, kw_only=True, slots=True)
class Derived(Shape[M_co]):
    """A model whose JSON schema is determined at run time, for example from a ROS interface.

    Attributes:
        model: model of a call's arguments or of a result.
        properties: JSON schema of each field that is used, merged into the model's own; `enum` and
            `maximum` are checked. Results leave out what their handler did not set.
        required: names of the fields that must be given.
    """

    model: type[M_co]
    properties: Mapping[str, JsonSchemaValue]
    required: Sequence[str] = ()

    def schema(self, own: JsonSchemaValue) -> JsonSchemaValue:
        """Return the strict JSON schema of the used fields, with the definitions that they need."""
        definitions: JsonSchemaValue = {}
        properties: dict[str, JsonSchemaValue] = {}
        for name, part in self.properties.items():
            entry = {**own["properties"].get(name, {}), **part}
            definitions |= entry.pop("$defs", {})
            properties[name] = entry
        # done for each call: costs as much as a small message
        used = repr(properties) if "$defs" in own else ""
        definitions |= {
            name: entry
            for name, entry in own.get("$defs", {}).items()
            if f"#/$defs/{name}'" in used
        }
        schema: JsonSchemaValue = {
            "type": "object",
            "properties": properties,
            "additionalProperties": False,
        }
        if self.required:
            schema["required"] = list(self.required)
        return {**schema, "$defs": definitions} if definitions else schema

    def check(self, name: str, value: object) -> None:
        """Raise InvalidInputError for a value outside the field's `enum`, or above its
        `maximum`.
        """
        schema = self.properties[name]
        if "enum" in schema and value not in schema["enum"]:
            raise InvalidInputError.no_choice(name, value, schema["enum"])
        if isinstance(value, int | float) and value > schema.get("maximum", value):
            raise InvalidInputError(
                f"Argument {name!r} is {value:g}, expected up to {schema['maximum']:g}.", path=name
            )
