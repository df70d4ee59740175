"""JSON schemas: portable keywords only, small, and the same verdict as the encoder.

What a portable schema cannot say is left out of the agreement: NUL and half surrogates in text,
bytes of non-ASCII text, whether base64 is valid, integers beyond the float64 range, and the input
limits.
"""

from __future__ import annotations

import json
import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from roboneuron.errors import InvalidInputError
from roboneuron.tools.ros.interfaces import (
    Array,
    MessageType,
    Nested,
    list_interfaces,
    load_message,
)

NAMES = [str(name) for name in list_interfaces()]
KEYWORDS = {
    "type",
    "properties",
    "required",
    "additionalProperties",
    "items",
    "minItems",
    "maxItems",
    "minimum",
    "maximum",
    "maxLength",
    "enum",
    "anyOf",
    "default",
    "description",
    "$defs",
    "$ref",
}
JUNK = (
    None,
    True,
    False,
    0,
    1,
    -1,
    1.5,
    2.0,
    -0.0,
    10**20,
    -(10**20),
    1e308,
    "",
    "a",
    "ADD",
    [],
    [0],
    [""],
    [[]],
    {},
    {"x": 0},
    {"sec": 1},
    {"sec": 1.5},
)


def check_portable(schema: Any, where: str) -> None:
    assert set(schema) <= KEYWORDS, where
    assert {"type", "anyOf", "$ref"} & set(schema), f"{where} has no type"
    if schema.get("type") == "object":
        assert schema["additionalProperties"] is False, where
        assert set(schema.get("required", ())) <= set(schema["properties"])
        for name, inner in schema["properties"].items():
            check_portable(inner, f"{where}.{name}")
    if schema.get("type") == "array":
        check_portable(schema["items"], f"{where}[]")
    for inner in (*schema.get("anyOf", ()), *schema.get("$defs", {}).values()):
        check_portable(inner, where)
    assert isinstance(schema.get("type", ""), str), where


def test_every_schema_is_valid_strict_and_small(interface_values) -> None:
    sizes = []
    for name in NAMES:
        for part in interface_values.parts_of(name):
            schema = part.json_schema()
            Draft202012Validator.check_schema(schema)
            check_portable(schema, part.name)
            assert schema["type"] == "object"
            sizes.append(len(json.dumps(schema)))
    sizes.sort()
    assert sizes[len(sizes) // 2] < 2000
    assert sizes[-1] < 25_000


def test_schemas_are_inline_unless_they_grow_too_large() -> None:
    assert "$ref" not in json.dumps(load_message("nav_msgs/msg/Odometry").json_schema())
    large = load_message("test_msgs/msg/MultiNested")
    assert (
        len(json.dumps(large.json_schema()))
        < len(json.dumps(large.json_schema(inline_bytes=10**9))) / 3
    )
    assert "$ref" not in json.dumps(large.json_schema(inline_bytes=10**9))


def test_a_schema_is_a_copy() -> None:
    part = load_message("geometry_msgs/msg/Twist")
    part.json_schema()["properties"].clear()
    assert part.json_schema()["properties"]


def damage(value: Any, rng: random.Random) -> Any:
    """Replace, add or remove one thing somewhere inside."""
    if isinstance(value, dict) and value and rng.random() < 0.8:
        name = rng.choice(sorted(value))
        return {**value, name: damage(value[name], rng)}
    if isinstance(value, list) and value and rng.random() < 0.6:
        index = rng.randrange(len(value))
        return [*value[:index], damage(value[index], rng), *value[index + 1 :]]
    if isinstance(value, list) and rng.random() < 0.5:
        return value[:-1] if rng.random() < 0.5 else [*value, *value, 0]
    if isinstance(value, dict) and rng.random() < 0.5:
        return (
            {**value, "unknown": 1}
            if rng.random() < 0.5 or not value
            else dict(list(value.items())[1:])
        )
    if isinstance(value, str) and rng.random() < 0.3:
        return value + "x" * 30
    return rng.choice(JUNK)


def says_base64(message: MessageType, value: Any) -> bool:
    """Whether some bytes field holds a text: the schema cannot tell valid base64 from other
    text.
    """
    if not isinstance(value, dict):
        return False
    for field in message.fields:
        given = value.get(field.name)
        if isinstance(field.type, Array):
            if field.type.is_bytes and isinstance(given, str):
                return True
            if isinstance(field.type.element, Nested) and isinstance(given, list):
                inner = field.type.element.message
                if any(says_base64(inner, item) for item in given):
                    return True
        elif isinstance(field.type, Nested) and says_base64(field.type.message, given):
            return True
    return False


@pytest.mark.sampled(every=8)
@pytest.mark.parametrize("name", NAMES)
def test_schema_and_encoder_give_the_same_verdict(name: str, interface_values) -> None:
    validators = [
        (part, Draft202012Validator(part.json_schema())) for part in interface_values.parts_of(name)
    ]

    @settings(max_examples=25, deadline=None, derandomize=True, database=None)
    @given(seed=st.integers(0, 2**32 - 1), damages=st.integers(0, 2))
    def check(seed: int, damages: int) -> None:
        rng = random.Random(seed)
        for part, validator in validators:
            value: Any = interface_values.ValueGenerator(seed, portable=True).value(part.message)
            for _ in range(damages):
                value = damage(value, rng)
            valid = validator.is_valid(value)
            if valid and says_base64(part.message, value):
                continue
            try:
                part.encode(value, now_ns=0)
                accepted = True
            except InvalidInputError:
                accepted = False
            assert valid == accepted, value

    check()
