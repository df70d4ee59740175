"""JSON schemas of pydantic models for agents, and validation of calls against the models."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cache
from types import UnionType
from typing import Any, Generic, Literal, TypeVar, Union, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import to_json

from roboneuron.errors import InvalidInputError, shortened
from roboneuron.plugins.loading import option_names

_LISTED: Mapping[object, str] = {
    **dict.fromkeys((str, int, float, bool, Literal, Union, UnionType), ""),
    **dict.fromkeys((list, tuple), "array"),
    **dict.fromkeys((dict, type(BaseModel)), "object"),
}
"""Field types that `listed_output` lists without building a schema."""
_NO_JSON = "The call holds text that is no Unicode, or is nested too deeply."
M = TypeVar("M", bound=BaseModel)
M_co = TypeVar("M_co", bound=BaseModel, covariant=True)


class Shape(ABC, Generic[M_co]):
    """A subset of the fields of `model`, as one tool takes or returns them; results leave out what
    their handler did not set.

    Attributes:
        model: the model with all fields.
        properties: JSON schema by field that a call may give.
        required: fields that a call must give.
    """

    model: type[M_co]
    properties: Mapping[str, JsonSchemaValue]
    required: Sequence[str]

    @abstractmethod
    def schema(self, own: JsonSchemaValue) -> JsonSchemaValue:
        """Return the strict JSON schema of `properties` and `required`, from the model's own."""

    @abstractmethod
    def check(self, name: str, value: object) -> None:
        """Raise InvalidInputError for a value that fits the model but not the tool."""


def model_schema(
    kind: type[BaseModel] | Shape[BaseModel], *, result: bool = False
) -> JsonSchemaValue:
    """Return the strict JSON schema of arguments, or of a result; `$defs` are collected at its
    root.
    """
    return (
        kind.schema(_own_schema(kind.model, result))
        if isinstance(kind, Shape)
        else _own_schema(kind, result)
    )


@cache
def _own_schema(model: type[BaseModel], result: bool) -> JsonSchemaValue:
    made = model.model_json_schema(mode="serialization" if result else "validation")
    schema: JsonSchemaValue = _plain(made, keep_null=result)
    return {**schema, "properties": schema.get("properties", {})}


def with_choices(
    schema: JsonSchemaValue, choices: Mapping[str, Mapping[str, str]]
) -> JsonSchemaValue:
    """Add {allowed value: one-line summary} to arguments of a schema: as an enum, and as summaries
    in the description.
    """
    properties = dict(schema["properties"])
    for name, allowed in choices.items():
        entry = dict(properties[name])
        if allowed:
            listed = "; ".join(
                f"{value}: {summary}" if summary else value for value, summary in allowed.items()
            )
            if any(allowed.values()):
                entry["description"] = f"{entry.get('description', '')} Choices: {listed}."
            if entry.get("type") == "array":
                entry["items"] = {**entry["items"], "enum": list(allowed)}
            else:
                entry["enum"] = list(allowed)
        else:
            entry["description"] = (
                f"{entry.get('description', '')} Nothing is installed to choose from."
            )
        properties[name] = entry
    return {**schema, "properties": properties}


def listed_output(kind: type[BaseModel] | Shape[BaseModel]) -> JsonSchemaValue:
    """Return the output schema for `tools/list`: the fields of the answer, and which of them hold
    several values.

    Agents read the whole list first, so types of single values, the content of nested objects and
    the meaning of fields are left to docs/tools.md.
    """
    fields = None if isinstance(kind, Shape) else _known_fields(kind)
    if fields is None:
        fields = {
            name: _listed_field("object" if "$ref" in entry else entry.get("type"))
            for name, entry in model_schema(kind, result=True)["properties"].items()
        }
    return {"type": "object", "properties": fields}


def _listed_field(kind: object) -> JsonSchemaValue:
    return {"type": kind} if kind in ("object", "array") else {}


def _known_fields(model: type[BaseModel]) -> dict[str, JsonSchemaValue] | None:
    """Return `_listed_field` of each field without building the model's schema, which takes a
    millisecond and is needed for a call only; None if a field is more complex than a type.
    """
    own = model.__pydantic_decorators__
    has_more = bool(own.computed_fields or own.field_serializers or own.model_serializers) or any(
        field.metadata or field.exclude or field.serialization_alias or field.json_schema_extra
        for field in model.model_fields.values()
    )
    kinds = {name: _kind_of(field.annotation) for name, field in model.model_fields.items()}
    if has_more or not _LISTED.keys() >= set(kinds.values()):
        return None
    return {name: _listed_field(_LISTED[kind]) for name, kind in kinds.items()}


def _kind_of(annotation: object) -> object:
    return (
        type(BaseModel)
        if isinstance(annotation, type(BaseModel))
        else get_origin(annotation) or annotation
    )


def _plain(node: Any, *, keep_null: bool) -> Any:
    """Drop generated titles, class docstrings and defaults that are empty, 0 or false; for inputs
    also null for optional arguments.
    """
    if isinstance(node, list):
        return [_plain(item, keep_null=keep_null) for item in node]
    if not isinstance(node, dict):
        return node
    cleaned = {
        key: (
            {name: _plain(entry, keep_null=keep_null) for name, entry in value.items()}
            if key in ("properties", "$defs")
            else _plain(value, keep_null=keep_null)
        )
        for key, value in node.items()
        if not (key == "title" and isinstance(value, str))
        and not (key == "description" and "properties" in node)
        and not (key == "default" and not value)
        and not (key == "additionalProperties" and value is True)
    }
    alternatives = cleaned.get("anyOf")
    if (
        not keep_null
        and alternatives
        and {"type": "null"} in alternatives
        and len(alternatives) == 2
    ):
        del cleaned["anyOf"]
        cleaned = {**next(a for a in alternatives if a != {"type": "null"}), **cleaned}
    return cleaned


def parse(
    kind: type[M] | Shape[M],
    arguments: Mapping[str, Any],
    choices: Mapping[str, Mapping[str, str]] | None = None,
) -> M:
    """Parse the arguments of a call; null for an optional argument counts as omitted.

    Raises:
        InvalidInputError: they do not fit; names the argument, the value and what is allowed.
    """
    names: Mapping[str, object]
    if isinstance(kind, Shape):
        model, names, required, check = kind.model, kind.properties, kind.required, kind.check
    else:
        model, names, check = kind, kind.model_fields, None
        required = tuple(name for name, field in kind.model_fields.items() if field.is_required())
    for name in arguments:
        if name not in names:
            raise InvalidInputError.unknown_name("The call", name, tuple(names))
    given = {
        name: value for name, value in arguments.items() if value is not None or name in required
    }
    for name in required:
        if name not in given:
            raise InvalidInputError(f"Argument {name!r} is missing.", path=name)
    for name, value in given.items():
        # to JSON, 1.0 is an integer
        if (
            isinstance(value, float)
            and value.is_integer()
            and model.model_fields[name].annotation is int
        ):
            given[name] = int(value)
    try:
        # as JSON: strict, but a list is accepted for a tuple
        parsed = model.model_validate_json(to_json(given, inf_nan_mode="constants"))
    except ValidationError as error:
        raise _explain(model, error) from error
    except ValueError as error:
        raise InvalidInputError(_NO_JSON) from error
    for name, allowed in (choices or {}).items():
        value = getattr(parsed, name)
        for item in value if isinstance(value, list) else [] if value is None else [value]:
            if allowed and item not in allowed:
                raise InvalidInputError.no_choice(name, item, list(allowed))
    if check is not None:
        for name in given:
            check(name, getattr(parsed, name))
    return parsed


def _explain(model: type[BaseModel], error: ValidationError) -> InvalidInputError:
    """Describe the first error in JSON terms; an unknown name first, as it may explain the
    others.
    """
    errors = error.errors(include_url=False)
    first = next((found for found in errors if found["type"] == "extra_forbidden"), errors[0])
    *outer, last = first["loc"] or ("",)
    path = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return InvalidInputError.unknown_name(
            f"Argument {'.'.join(map(str, outer))!r}", str(last), option_names(model, outer)
        )
    if first["type"] == "missing":
        return InvalidInputError(f"Argument {path!r} is missing.", path=path)
    if first["type"] == "literal_error":
        allowed = re.findall(r"'([^']*)'", first["ctx"]["expected"])
        return InvalidInputError.no_choice(path, first["input"], allowed)
    if first["type"] == "json_invalid":
        return InvalidInputError(_NO_JSON)
    return InvalidInputError(
        f"Argument {path!r} is {shortened(first['input'])}, "
        f"{first['msg'].replace('Input should be ', 'expected ')}.",
        path=path,
    )
