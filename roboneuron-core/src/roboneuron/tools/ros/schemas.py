"""Schemas of derived tools: messages with the endpoint's limits, and decoded messages."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from pydantic.json_schema import JsonSchemaValue

from roboneuron.contract import Endpoint
from roboneuron.tools.ros.interfaces import (
    Array,
    FieldType,
    MessageInterface,
    MessageType,
    Nested,
    Scalar,
)
from roboneuron.tools.ros.interfaces.summary import SUMMARIES

_OF_TYPES = frozenset(
    {*(-(2**bits) for bits in (7, 15, 31, 63)), *(2**b - 1 for b in (7, 8, 15, 16, 31, 32, 63, 64))}
)
"""Smallest and largest values of ROS's integer types."""
_DEPTH = 4
"""Depth from which messages are described as objects only, to keep the schema short."""


def message_schema(
    part: MessageInterface, bounds: Mapping[str, tuple[float, float]]
) -> JsonSchemaValue:
    """Schema of the values that the encoder accepts, with the endpoint's limits in their fields."""
    schema = part.json_schema()
    for path, (low, high) in bounds.items():
        _bound(schema, path.split("."), low, high)
    schema.pop("description", None)  # of the type; the tool describes the message's effect
    return dict(_short(schema))


def _short(node: Any) -> Any:
    """Shorten a schema: times in seconds only, no bounds of the type itself, and no truncated
    comments (describe_interface has all of it).
    """
    if isinstance(node, list):
        return [_short(item) for item in node]
    if not isinstance(node, dict):
        return node
    times = node.get("anyOf", ())
    if any(set(option.get("properties", ())) == {"sec", "nanosec"} for option in times):
        return {
            "type": "number",
            "description": f"{node.get('description', 'Time').rstrip('.')} [s].",
        }
    return {
        key: _short(value)
        for key, value in node.items()
        if not (key in ("minimum", "maximum") and value in _OF_TYPES)
        and not (key == "description" and str(value).endswith("..."))
    }


def _bound(schema: JsonSchemaValue, path: list[str], low: float, high: float) -> None:
    node: Any = schema
    for name in path:
        node = node.get("items", node) if isinstance(node, dict) else {}
        node = node.get("properties", {}).get(name)
        if not isinstance(node, dict):
            return
    node = node.get("items", node)
    if node.get("type") in ("number", "integer"):
        node |= {"minimum": low, "maximum": high}


def hull(endpoints: list[Endpoint]) -> dict[str, tuple[float, float]]:
    """Bounds that hold for all of several robots' endpoints: fields bounded by all, with the widest
    range.
    """
    shared = set.intersection(*(set(e.bounds) for e in endpoints))
    return {
        path: (min(e.bounds[path][0] for e in endpoints), max(e.bounds[path][1] for e in endpoints))
        for path in sorted(shared)
    }


def decoded_schema(part: MessageInterface) -> JsonSchemaValue:
    """Schema of the result of `MessageInterface.decode`, with its limits."""
    return _object(part.message, _DEPTH)


def _object(message: MessageType, depth: int) -> JsonSchemaValue:
    if depth == 0:
        return {"type": "object"}
    properties = {}
    for field in message.fields:
        if (message.type_name, field.name) in SUMMARIES:
            properties[field.name] = {"type": "object", "description": "summary"}
        else:
            properties[field.name] = _type(field.type, depth, bool(field.choices))
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _type(field_type: FieldType, depth: int, named: bool) -> JsonSchemaValue:
    if isinstance(field_type, Array):
        return {"type": ["array", "object"], "items": _type(field_type.element, depth, named)}
    if isinstance(field_type, Nested):
        return _object(field_type.message, depth - 1)
    return _scalar(field_type, named)


def _scalar(scalar: Scalar, named: bool) -> JsonSchemaValue:
    if scalar.ros == "boolean":
        return {"type": "boolean"}
    if scalar.is_integer:
        return {"type": ["integer", "string"] if named else "integer"}
    if scalar.is_float:
        return {"type": ["number", "string"]}
    return {"type": ["string", "object"]}


def copied(schema: JsonSchemaValue) -> JsonSchemaValue:
    """A modifiable copy of a schema."""
    return copy.deepcopy(schema)
