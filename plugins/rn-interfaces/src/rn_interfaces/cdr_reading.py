"""CDR decoding of a message class: one function per class, assembled from its `SLOT_TYPES`.

Consecutive fields of a fixed size are unpacked together.
"""

from __future__ import annotations

import array
import sys
from collections.abc import Callable
from functools import cache
from struct import calcsize
from typing import Any

import numpy as np
from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractNestedType,
    AbstractWString,
    Array,
    BasicType,
    NamespacedType,
)

from rn_interfaces.cdr_fields import (
    COUNT,
    EMPTY,
    WIDE,
    CdrError,
    PackedNumbers,
    format_of,
    length_check,
    members_of,
    type_of,
)

Bytes = bytes | bytearray | memoryview
"""Input of decoding; decoded values do not refer to it."""
Read = Callable[[Bytes, int, int], tuple[Any, int]]
"""Decodes a value from bytes, a position and their end; returns it with the position after it."""
_CONTINUING = bytes(range(0x80, 0xC0))
"""Continuation bytes of UTF-8."""


def wide_text(data: bytes | bytearray) -> str:
    """Decode UTF-16 units of four bytes each. Raises OverflowError for a unit beyond UTF-16."""
    units = array.array("H", array.array("I", data))
    return units.tobytes().decode("utf-16-le", "replace")


Step = Callable[[object, Bytes, int, int], int]
"""Fills a message from bytes, a position and their end; returns the position after the read
part.
"""


@cache
def reader(cls: type) -> Read:
    """Create the function that reads a message of a class. Raises CdrError."""
    steps: list[Step] = []
    pending: list[tuple[str, str]] = []
    members = members_of(cls)
    for name, slot in members or [("", None)]:
        if slot is None:
            pending.append((EMPTY, ""))
        elif isinstance(slot, BasicType):
            pending.append((format_of(slot), name))
        else:
            _end_reads(cls, steps, pending)
            steps.append(_set_field(cls, name, _read_value(cls, name, slot)))
    _end_reads(cls, steps, pending)
    new: Any = cls.__new__
    unchecked = getattr(cls, "_check_fields").__set__  # noqa: B009  (a slot, unknown to checkers)

    def read(data: Bytes, place: int, end: int) -> tuple[object, int]:
        message = new(cls)  # __init__ would fill and check each field first
        unchecked(message, False)
        for step in steps:
            place = step(message, data, place, end)
        return message, place

    return read


def _set_field(cls: type, name: str, read: Read) -> Step:
    put = getattr(cls, name).__set__

    def step(message: object, data: Bytes, place: int, end: int) -> int:
        value, place = read(data, place, end)
        put(message, value)
        return place

    return step


def _end_reads(cls: type, steps: list[Step], pending: list[tuple[str, str]]) -> None:
    if not pending:
        return
    runs = PackedNumbers("".join(form for form, _ in pending)).at
    puts = [getattr(cls, name).__set__ for _, name in pending if name]
    pending.clear()

    def step(message: object, data: Bytes, place: int, end: int) -> int:
        run = runs[place & 7]
        for put, value in zip(puts, run.unpack_from(data, place), strict=True):
            put(message, value)
        return place + run.size

    steps.append(step)


def _read_value(owner: type, name: str, slot: object) -> Read:
    if isinstance(slot, NamespacedType):
        return reader(type_of(owner, slot))
    if isinstance(slot, AbstractGenericString):
        return _read_text(slot)
    if not isinstance(slot, AbstractNestedType):
        raise CdrError(f"{name}: no encoding of {type(slot).__name__}")
    entries = _read_entries(owner, name, slot)
    if isinstance(slot, Array):
        size = slot.size
        return lambda data, place, end: entries(data, place, end, size)
    check = length_check(slot, name.lstrip("_"))

    def read(data: Bytes, place: int, end: int) -> tuple[object, int]:
        head = COUNT[place & 7]
        (count,) = head.unpack_from(data, place)
        check(count)
        return entries(data, place + head.size, end, count)

    return read


def _check_rest(count: int, size: int, place: int, end: int) -> None:
    if count * size > end - place:
        raise CdrError(f"an entry of {count} elements is longer than the rest of the message")


def _read_text(slot: AbstractGenericString) -> Read:
    most = slot.maximum_size if slot.has_maximum_size() else sys.maxsize
    wide = isinstance(slot, AbstractWString)
    size = WIDE if wide else 1

    def read(data: Bytes, place: int, end: int) -> tuple[str, int]:
        head = COUNT[place & 7]
        (count,) = head.unpack_from(data, place)
        place += head.size
        _check_rest(count, size, place, end)
        after = place + count * size
        if wide:
            length, text = count, wide_text(bytes(data[place:after]))
        else:  # some vendors send an empty text without its closing zero
            encoded = bytes(data[place : after - 1]) if count else b""
            length, text = count - 1, encoded.decode("utf-8", "replace")
            if length > most:  # a bound counts characters, and replaced ones as native.c does
                length = len(encoded.translate(None, _CONTINUING))
        if length > most:
            raise CdrError(f"a text of {length} characters, the type allows {most}")
        return text, after

    return read


Entries = Callable[[Bytes, int, int, int], tuple[Any, int]]
"""Like Read, with the count as the last argument."""


def _read_entries(owner: type, name: str, slot: AbstractNestedType) -> Entries:
    value = slot.value_type
    if isinstance(value, BasicType):
        return _read_numbers(value, isinstance(slot, Array))
    one = _read_value(owner, name, value)

    def read(data: Bytes, place: int, end: int, count: int) -> tuple[object, int]:
        _check_rest(count, 1, place, end)
        found = []
        for _ in range(count):
            entry, place = one(data, place, end)
            found.append(entry)
        return found, place

    return read


def _read_numbers(slot: BasicType, is_fixed: bool) -> Entries:
    form = format_of(slot)
    size = calcsize(f"<{form}")

    def unpack(data: memoryview) -> object:
        if slot.typename == "octet":
            return [bytes((one,)) for one in data]
        if slot.typename == "boolean":
            return [bool(one) for one in data]
        if is_fixed:
            return np.frombuffer(data, form).copy()
        found = array.array(form)
        found.frombytes(data)
        return found

    def read(data: Bytes, place: int, end: int, count: int) -> tuple[object, int]:
        if count:
            place += -place % size
        _check_rest(count, size, place, end)
        after = place + count * size
        return unpack(memoryview(data)[place:after]), after

    return read
