"""Conversion of a rosidl message to plain values for an agent, within size limits.

Values that are given completely can be encoded again to an equal message. Received messages are
never refused: values that cannot be shown are marked as damaged.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboneuron.tools.ros.interfaces.bounds import DecodeLimits
from roboneuron.tools.ros.interfaces.description import (
    Array,
    FieldType,
    MessageField,
    MessageType,
    Plain,
    Scalar,
)
from roboneuron.tools.ros.interfaces.summary import SUMMARIES, summarize_numbers, to_number

_LONG_BYTES = 64


@dataclass(slots=True)
class _Room:
    """Remaining size limits of this message."""

    limits: DecodeLimits
    values: float


_Decoder = Callable[[object, _Room], Plain]


class MessageDecoder:
    """Decoder of messages of one type. Built once per type; stateless between calls, usable from
    any thread.
    """

    def __init__(
        self, message: MessageType, cache: dict[int, MessageDecoder] | None = None
    ) -> None:
        made = {} if cache is None else cache
        self._fields = [
            (f.name, _make(f, f.type, made), SUMMARIES.get((message.type_name, f.name)))
            for f in message.fields
        ]

    def decode(self, message: object, limits: DecodeLimits) -> dict[str, Plain]:
        """Return the message as plain values within `limits`."""
        return self.read(
            message, _Room(limits, math.inf if limits.values is None else limits.values)
        )

    def read(self, message: object, room: _Room) -> dict[str, Plain]:
        """Like `decode`, for a message inside another."""
        lossless = room.limits.items is None
        result: dict[str, Plain] = {}
        for name, decode, summarize in self._fields:
            if summarize is None or lossless:
                result[name] = decode(getattr(message, name), room)
            else:
                result[name] = summarize(message, room.limits)
        return result


def _make(field: MessageField, field_type: FieldType, made: dict[int, MessageDecoder]) -> _Decoder:
    if isinstance(field_type, Scalar):
        return _make_scalar(field_type, field)
    if isinstance(field_type, Array):
        return _make_array(field_type, _make(field, field_type.element, made))
    nested = field_type.message
    decoder = made.get(id(nested))
    if decoder is None:
        decoder = made[id(nested)] = MessageDecoder(nested, made)
    return decoder.read


def _make_scalar(scalar: Scalar, field: MessageField) -> _Decoder:
    if scalar.is_text:
        return _decode_text
    if scalar.is_float:
        return _decode_float32 if scalar.ros == "float" else _decode_float64
    if scalar.ros == "boolean":
        return lambda value, room: bool(value)
    names: dict[int, str] = {}
    for choice in field.choices:
        names.setdefault(choice.value, choice.name)
    octet = scalar.ros == "octet"

    def decode_integer(value: Any, room: _Room) -> Plain:
        number = value[0] if octet else int(value)
        return names.get(number, number) if room.limits.names else number

    return decode_integer


def _decode_text(value: Any, room: _Room) -> Plain:
    longest = room.limits.text
    if longest is None or len(value) <= longest:
        return str(value)
    return {"length": len(value), "first": value[:longest]}


def _decode_float64(value: Any, room: _Room) -> Plain:
    return float(value) if value - value == 0.0 else to_number(value)


def _decode_float32(value: Any, room: _Room) -> Plain:
    """The shortest decimal that rounds to the same float32: 0.1 instead of 0.10000000149011612."""
    return float(str(np.float32(value))) if value - value == 0.0 else to_number(value)


def _make_array(shape: Array, element: _Decoder) -> _Decoder:
    numeric = isinstance(shape.element, Scalar) and (
        shape.element.is_float or shape.element.is_integer
    )
    octets = isinstance(shape.element, Scalar) and shape.element.ros == "octet"

    def decode(values: Any, room: _Room) -> Plain:
        length, limits = len(values), room.limits
        if limits.items is None and shape.is_bytes and length > _LONG_BYTES:
            return base64.b64encode(_to_bytes(values, octets)).decode("ascii")
        if (limits.items is None or length <= limits.items) and length <= room.values:
            room.values -= length
            return [element(value, room) for value in values]
        shown = int(min(limits.first, room.values, length))
        room.values -= shown
        first = [element(values[i], room) for i in range(shown)]
        if numeric:
            array = (
                np.frombuffer(_to_bytes(values, octets), dtype=np.uint8)
                if octets
                else np.asarray(values)
            )
            return summarize_numbers(array, first)
        return {"length": length, "first": first}

    return decode


def _to_bytes(values: Any, octets: bool) -> bytes:
    return b"".join(values) if octets else bytes(values)
