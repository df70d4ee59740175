"""JSON schemas for every MCP client: types always given, basic keywords only.

Used keywords: type, properties, required, additionalProperties, items, minItems, maxItems, minimum,
maximum, maxLength, enum, anyOf, default, description; `$defs` and `$ref` only if a schema would
otherwise exceed `INLINE_BYTES`.
"""

from __future__ import annotations

import json
import math
from collections import Counter

from pydantic.json_schema import JsonSchemaValue

from roboneuron.tools.ros.interfaces.description import (
    FLOAT32_MAX,
    Array,
    FieldType,
    MessageField,
    MessageType,
    Nested,
    Plain,
    Scalar,
)
from roboneuron.tools.ros.interfaces.scalars import NONFINITE_NAMES

INLINE_BYTES = 8192
"""Size above which a schema uses `$defs` for repeated messages. Most clients support references, a
few do not.
"""

_SHORT, _LONG = 110, 400
_MOST_DEFAULT = 16
"""Longest array whose default is shown."""
Schema = JsonSchemaValue


def make_schema(message: MessageType, *, inline_bytes: int = INLINE_BYTES) -> Schema:
    """Return the schema of the values that the encoder of `message` accepts; a new dictionary at
    each call.
    """
    schema = _Writer(shared=frozenset()).write_root(message)
    if len(json.dumps(schema)) <= inline_bytes:
        return schema
    uses = Counter(_nested_names(message))
    shared = frozenset(name for name, count in uses.items() if count > 1)
    return _Writer(shared=shared).write_root(message)


def _nested_names(message: MessageType) -> list[str]:
    names = []
    for _, field in message.walk():
        element = field.type.element if isinstance(field.type, Array) else field.type
        if isinstance(element, Nested):
            names.append(element.message.type_name)
    return names


class _Writer:
    """Writes one schema; `shared` are the type names that go to `$defs`."""

    def __init__(self, shared: frozenset[str]) -> None:
        self._shared = shared
        self._defs: dict[str, Schema] = {}

    def write_root(self, message: MessageType) -> Schema:
        schema = self._object(message)
        text = _clip(_message_text(message), _LONG)
        schema = {"type": "object", **({"description": text} if text else {}), **schema}
        if self._defs:
            schema["$defs"] = dict(sorted(self._defs.items()))
        return schema

    def _object(self, message: MessageType) -> Schema:
        schema: Schema = {
            "type": "object",
            "properties": {f.name: self._field(f) for f in message.fields},
        }
        if message.required:
            schema["required"] = list(message.required)
        schema["additionalProperties"] = False
        return schema

    def _field(self, field: MessageField) -> Schema:
        schema = self._type(field.type)
        if field.choices:
            schema = {
                "anyOf": [schema, {"type": "string", "enum": [c.name for c in field.choices]}]
            }
        text = field_text(field)
        if text:
            schema = {**schema, "description": text}
        if field.default is not None and _is_shown(field.default):
            schema["default"] = field.default
        return schema

    def _type(self, field_type: FieldType) -> Schema:
        if isinstance(field_type, Scalar):
            return _scalar(field_type)
        if isinstance(field_type, Nested):
            return self._nested(field_type.message)
        schema: Schema = {"type": "array", "items": self._type(field_type.element)}
        if field_type.fixed:
            schema["minItems"] = field_type.size
        if field_type.size is not None:
            schema["maxItems"] = field_type.size
        return (
            {"anyOf": [schema, {"type": "string", "description": "base64"}]}
            if field_type.is_bytes
            else schema
        )

    def _nested(self, message: MessageType) -> Schema:
        if message.type_name not in self._shared:
            return self._message(message)
        name = message.type_name.replace("/", ".")
        if name not in self._defs:
            self._defs[name] = {}
            self._defs[name] = self._message(message)
        return {"$ref": f"#/$defs/{name}"}

    def _message(self, message: MessageType) -> Schema:
        if not message.is_time:
            return self._object(message)
        parts = {f.name: self._type(f.type) for f in message.fields}
        seconds = {
            "type": "number",
            "description": "seconds",
            "minimum": -(1 << 31),
            "maximum": (1 << 31) - 1,
        }
        return {
            "anyOf": [
                seconds,
                {"type": "object", "properties": parts, "additionalProperties": False},
            ]
        }


def _is_shown(default: Plain) -> bool:
    """True for defaults that are short and that JSON can hold."""
    values = default if isinstance(default, list) else [default]
    return len(values) <= _MOST_DEFAULT and all(
        math.isfinite(value) for value in values if isinstance(value, float)
    )


def _scalar(scalar: Scalar) -> Schema:
    if scalar.ros == "boolean":
        return {"type": "boolean"}
    if scalar.is_integer:
        return {"type": "integer", "minimum": scalar.lower, "maximum": scalar.upper}
    if scalar.is_text:
        return (
            {"type": "string"}
            if scalar.max_length is None
            else {"type": "string", "maxLength": scalar.max_length}
        )
    number: Schema = {"type": "number"}
    if scalar.ros == "float":
        number |= {"minimum": -FLOAT32_MAX, "maximum": FLOAT32_MAX}
    return (
        number
        if scalar.finite
        else {"anyOf": [number, {"type": "string", "enum": list(NONFINITE_NAMES)}]}
    )


def field_text(field: MessageField) -> str:
    """Text of a field in one line: comment, unit, and the type of nested messages without a
    comment.
    """
    text = field.text
    element = field.type.element if isinstance(field.type, Array) else field.type
    if not text and isinstance(element, Nested):
        text = _first_sentence(element.message.text)
    text = _clip(text, _SHORT)
    if field.unit and field.unit != "enum":
        text = f"{text} [{field.unit}]".strip()
    if isinstance(element, Nested) and element.message.is_header:
        text = f"{text} An omitted stamp becomes now.".strip()
    return text


def _message_text(message: MessageType) -> str:
    placed = {c.name for f in message.fields for c in f.choices}
    loose = [f"{name}={value}" for name, value in message.constants if name not in placed]
    notes = (
        f" Constants: {', '.join(loose[:30])}{' ...' if len(loose) > 30 else ''}." if loose else ""
    )
    return _clip(message.text, _LONG - min(len(notes), 200)) + notes


def _first_sentence(text: str) -> str:
    head, dot, _ = text.partition(". ")
    return head + "." if dot else head


def _clip(text: str, length: int) -> str:
    """Truncate at the end of a sentence if possible, else at a word."""
    if len(text) <= length:
        return text
    cut = text[: length - 3]
    sentence = cut.rfind(". ")
    if sentence > length // 2 and not cut[:sentence].endswith((" e.g", " i.e", "(e.g", "(i.e")):
        return cut[: sentence + 1]
    return cut[: cut.rfind(" ")] + "..."
