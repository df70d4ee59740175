"""Messages with arbitrary values, and definitions with arbitrary fields."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
from rosidl_parser.definition import (
    AbstractGenericString,
    Array,
    BasicType,
    BoundedSequence,
    NamespacedType,
)

from rn_interfaces.cdr_fields import type_of

NUMBERS = (
    *("bool", "byte", "char", "float32", "float64"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
)
_LETTERS = "aé漢b z'\"\\"


def filled(cls: type, rng: random.Random) -> Any:
    """A message of a class with an arbitrary value in each field."""
    message: Any = cls()
    fields = cls.get_fields_and_field_types()  # type: ignore[attr-defined]
    for name, slot in zip(fields, cls.SLOT_TYPES, strict=True):  # type: ignore[attr-defined]
        setattr(message, name, _value(cls, slot, rng))
    return message


def _value(owner: type, slot: Any, rng: random.Random) -> Any:
    if isinstance(slot, BasicType):
        return _number(slot.typename, rng)
    if isinstance(slot, AbstractGenericString):
        longest = slot.maximum_size if slot.has_maximum_size() else 9
        return "".join(rng.choice(_LETTERS) for _ in range(rng.randrange(longest // 3 + 1)))
    if isinstance(slot, NamespacedType):
        return filled(type_of(owner, slot), rng)
    longest = slot.maximum_size if isinstance(slot, BoundedSequence) else 4
    count = slot.size if isinstance(slot, Array) else rng.randrange(longest + 1)
    return [_value(owner, slot.value_type, rng) for _ in range(count)]


def _number(typename: str, rng: random.Random) -> Any:
    if typename == "boolean":
        return rng.random() < 0.5
    if typename == "octet":
        return bytes([rng.randrange(256)])
    if typename in ("float", "double"):
        return float(np.float32(rng.uniform(-1e6, 1e6)))
    bits = 8 if typename == "char" else int(typename.lstrip("uint"))
    signed = typename.startswith("int")
    return rng.randrange(-(1 << bits - 1), 1 << bits - 1) if signed else rng.randrange(1 << bits)


def definition(rng: random.Random, earlier: list[str]) -> str:
    """A .msg with constants, comments, defaults, bounds, arrays and earlier messages."""
    lines = ['# What it\'s for: "tests", 漢.', "int32 LIMIT=7", f"string WORD='{'a' * 3}'"]
    for index in range(rng.randrange(1, 5)):
        name = f"field_{index}"
        lines += [f"# Comment of {name} [m/s]."] if rng.random() < 0.5 else []
        lines.append(f"{_field_type(rng, earlier)} {name}")
    lines += ["float64 speed 1.5", 'string<=8 label "it\'s"', "uint8[3] three [1, 2, 3]"]
    return "\n".join(lines) + "\n"


def _field_type(rng: random.Random, earlier: list[str]) -> str:
    base = rng.choice([*NUMBERS, "string", "wstring", "string<=9", "wstring<=6", "Header"])
    if base == "Header":
        base = rng.choice([*earlier, "geometry_msgs/Pose", "std_msgs/Header"])
    size = rng.randrange(1, 5)
    return base + rng.choice(["", "", "[]", f"[{size}]", f"[<={size}]"])
