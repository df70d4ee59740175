"""JSON schemas as agents read them, and messages that say what is wrong with arguments."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from jsonschema import Draft202012Validator
from jsonschema.exceptions import ValidationError, best_match
from pydantic import BaseModel

from roboneuron.errors import InvalidInputError

Schema = dict[str, Any]


def input_schema(model: type[BaseModel], choices: Mapping[str, Mapping[str, str]]) -> Schema:
    """The strict JSON schema of an argument model.

    Args:
        model: forbids unknown fields.
        choices: argument name -> {allowed value: one-line summary}; becomes an enum, summaries go to the description.
    """
    schema: Schema = _plain(model.model_json_schema())
    schema.setdefault("properties", {})
    for name, allowed in choices.items():
        entry = schema["properties"][name]
        target = entry["items"] if entry.get("type") == "array" else entry
        if allowed:
            target["enum"] = list(allowed)
            listed = "; ".join(f"{value}: {summary}" if summary else value for value, summary in allowed.items())
            entry["description"] = f"{entry.get('description', '')} Choices: {listed}."
        else:
            entry["description"] = f"{entry.get('description', '')} Nothing is installed to choose from."
    return schema


def output_schema(model: type[BaseModel]) -> Schema:
    """The JSON schema of a result model."""
    schema: Schema = _plain(model.model_json_schema(mode="serialization"), keep_null=True)
    return schema


def listed_output(schema: Schema) -> Schema:
    """An output schema as `tools/list` shows it: the fields of the answer and their types.

    Every agent reads the list in full before it does anything, so what is inside of nested objects, and what fields
    mean, is left to docs/tools.md.
    """
    fields = {name: _listed_field(entry) for name, entry in schema.get("properties", {}).items()}
    return {"type": "object", "properties": fields}


def _listed_field(entry: Schema) -> Schema:
    if "enum" in entry:
        return {"enum": entry["enum"]}
    if "$ref" in entry:
        return {"type": "object"}
    alternatives = [_listed_field(alternative).get("type") for alternative in entry.get("anyOf", ())]
    if alternatives and all(isinstance(kind, str) for kind in alternatives):
        return {"type": alternatives}
    return {"type": entry["type"]} if "type" in entry else {}


def _plain(node: Any, *, keep_null: bool = False) -> Any:
    """Drop generated titles and class docstrings; for inputs also the null alternative of optional arguments."""
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
        and not (key == "default" and value is None)
        and not (key == "additionalProperties" and value is True)
    }
    alternatives = cleaned.get("anyOf")
    if not keep_null and alternatives and {"type": "null"} in alternatives and len(alternatives) == 2:
        del cleaned["anyOf"]
        cleaned = {**next(a for a in alternatives if a != {"type": "null"}), **cleaned}
    return cleaned


def check_arguments(schema: Schema, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments without omitted ones (null for what is optional counts as omitted).

    Raises:
        InvalidInputError: they do not fit the schema; names which, what came and what is allowed.
    """
    required = schema.get("required", ())
    given = {k: v for k, v in arguments.items() if v is not None or k in required or k not in schema["properties"]}
    error = best_match(Draft202012Validator(schema).iter_errors(given))
    if error is not None:
        raise _explain(error)
    return given


def _explain(error: ValidationError) -> InvalidInputError:
    path = ".".join(str(part) for part in error.absolute_path)
    where = f"Argument {path!r}" if path else "The call"
    # a validation error raised by iter_errors() has all of these; the type of the library also allows for unset ones
    value: Any = error.instance
    expected: Any = error.validator_value
    rule: Any = error.schema
    if error.validator == "additionalProperties":
        valid = list(rule.get("properties", {}))
        unknown = next(key for key in value if key not in valid)
        close = get_close_matches(str(unknown), valid, n=1)
        hint = f"Did you mean {close[0]!r}?" if close else f"Valid: {', '.join(valid) or 'none'}."
        return InvalidInputError(f"{where} has no argument {unknown!r}.", hint=hint, path=str(unknown))
    if error.validator == "required":
        missing = next(key for key in expected if key not in value)
        return InvalidInputError(f"Argument {missing!r} is missing.", path=missing)
    if error.validator == "enum":
        close = get_close_matches(str(value), [str(e) for e in expected], n=1)
        nearest = f" Did you mean {close[0]!r}?" if close else ""
        return InvalidInputError(
            f"{where} is {_short(value)}.{nearest}",
            hint=f"Choose one of: {', '.join(str(e) for e in expected)}.",
            path=path,
        )
    if error.validator == "type":
        return InvalidInputError(f"{where} is {_short(value)}, expected {expected}.", path=path)
    return InvalidInputError(f"{where} is {_short(value)}: {error.validator} is {expected}.", path=path)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
