"""Conversion of a JSON object to a rosidl message with exactly these values, or to an error with a
remedy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from roboneuron.tools.ros.interfaces.arrays import make_array_encoder, make_list_encoder
from roboneuron.tools.ros.interfaces.description import Array, MessageType, Nested, Scalar
from roboneuron.tools.ros.interfaces.refusal import Mismatch, describe_value, unknown_field
from roboneuron.tools.ros.interfaces.scalars import Budget, Encoder, make_scalar_encoder

NANOSECONDS_PER_SECOND = 1_000_000_000
_INT32 = (-(1 << 31), (1 << 31) - 1)


class MessageEncoder:
    """Encoder of messages of one type. Built once per type; stateless between calls, usable from
    any thread.
    """

    def __init__(
        self, message: MessageType, cache: dict[int, MessageEncoder] | None = None
    ) -> None:
        made = {} if cache is None else cache
        self._message = message
        self.has_stamp: bool = message.is_header
        self._nested: dict[str, MessageEncoder] = {}
        self._values: dict[str, Encoder] = {}
        # their encoder would return a finite float as it is
        self._doubles: set[str] = set()
        self._stamped_lists: dict[str, MessageEncoder] = {}
        for field in message.fields:
            if isinstance(field.type, Scalar):
                self._values[field.name] = make_scalar_encoder(field.type, field.choices)
                if field.type.ros == "double":
                    self._doubles.add(field.name)
            elif isinstance(field.type, Nested):
                self._nested[field.name] = encoder_for(field.type.message, made)
            elif isinstance(field.type.element, Scalar):
                self._values[field.name] = make_list_encoder(field.type)
            else:
                self._add_messages(
                    field.name, field.type, encoder_for(field.type.element.message, made)
                )
        self._names = tuple(field.name for field in message.fields)
        self._required = message.required
        self._stamped = {n: e for n, e in self._nested.items() if e.has_stamp}
        self.has_stamp |= bool(self._stamped or self._stamped_lists)

    def _add_messages(self, name: str, shape: Array, element: MessageEncoder) -> None:
        self._values[name] = make_array_encoder(shape, element.make)
        if shape.fixed and element.has_stamp:
            self._stamped_lists[name] = element

    def make(self, value: object, budget: Budget) -> object:
        """Return a new message filled with `value`. Raises Mismatch."""
        message = self._message.ros_type()
        self.fill(message, value, budget)
        return message

    def fill(self, message: object, value: object, budget: Budget) -> None:
        """Set the fields in `value`, keep the defaults of the others, stamp omitted headers. Raises
        Mismatch.
        """
        if value.__class__ is not dict and not isinstance(value, Mapping):
            raise Mismatch(describe_value(value), self._describe())
        nested, values, doubles = self._nested, self._values, self._doubles
        for name, item in value.items():
            try:
                encode = values.get(name)
                if item.__class__ is float and name in doubles and item - item == 0.0:
                    setattr(message, name, item)
                elif encode is not None:
                    setattr(message, name, encode(item, budget))
                elif name in nested:
                    nested[name].fill(getattr(message, name), item, budget)
                else:
                    raise_unknown(name, self._names)
            except Mismatch as mismatch:
                if name in self._names:
                    mismatch.steps.append(name)
                raise
        for name in self._required:
            if name not in value:
                raise Mismatch("nothing", "a value: this field is required", name)
        if self.has_stamp and budget.now_ns is not None:
            self._stamp(message, budget.now_ns, value)

    def _stamp(self, message: Any, now_ns: int, given: Mapping[str, object]) -> None:
        if self._message.is_header and "stamp" not in given:
            message.stamp.sec, message.stamp.nanosec = divmod(now_ns, NANOSECONDS_PER_SECOND)
        for name, encoder in self._stamped.items():
            if name not in given:
                encoder._stamp(getattr(message, name), now_ns, {})
        for name, encoder in self._stamped_lists.items():
            if name not in given:
                for element in getattr(message, name):
                    encoder._stamp(element, now_ns, {})

    def _describe(self) -> str:
        return (
            f"an object with the fields {', '.join(self._names[:12])}"
            if self._names
            else "an empty object"
        )


class TimeEncoder(MessageEncoder):
    """Encoder of Time and Duration, which also accepts seconds, rounded to the nanosecond."""

    def fill(self, message: Any, value: object, budget: Budget) -> None:
        """Set seconds or {sec, nanosec}. Raises Mismatch."""
        if isinstance(value, int | float) and not isinstance(value, bool):
            message.sec, message.nanosec = split_seconds(value)
        else:
            super().fill(message, value, budget)

    def _describe(self) -> str:
        return "a number of seconds or {sec, nanosec}"


def split_seconds(seconds: float) -> tuple[int, int]:
    """Seconds -> (sec, nanosec) with 0 <= nanosec < 1e9, also for negative durations as in
    builtin_interfaces.

    Raises:
        Mismatch: not finite, or outside of int32 seconds.
    """
    allowed = f"finite seconds {_INT32[0]}..{_INT32[1]} or {{sec, nanosec}}"
    if (isinstance(seconds, float) and not math.isfinite(seconds)) or not _INT32[
        0
    ] <= seconds <= _INT32[1]:
        raise Mismatch(describe_value(seconds), allowed)
    whole = math.floor(seconds)
    nanoseconds = round((seconds - whole) * NANOSECONDS_PER_SECOND)
    carry, nanoseconds = divmod(nanoseconds, NANOSECONDS_PER_SECOND)
    return whole + carry, nanoseconds


def raise_unknown(name: object, names: tuple[str, ...]) -> None:
    """Raise the Mismatch for an unknown field."""
    raise unknown_field(name, names)


def encoder_for(message: MessageType, cache: dict[int, MessageEncoder]) -> MessageEncoder:
    """Return the encoder of a message, cached per description."""
    found = cache.get(id(message))
    if found is None:
        found = cache[id(message)] = (TimeEncoder if message.is_time else MessageEncoder)(
            message, cache
        )
    return found
