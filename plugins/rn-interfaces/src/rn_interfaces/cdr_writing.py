"""CDR encoding of a message class: one function per class, assembled from its `SLOT_TYPES`.

Consecutive fields of a fixed size are packed together, including those of nested messages.
"""

from __future__ import annotations

import array
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from operator import attrgetter
from struct import Struct, calcsize
from typing import Any

import numpy as np
from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractNestedType,
    AbstractSequence,
    AbstractWString,
    BasicType,
    NamespacedType,
    UnboundedSequence,
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

LARGE = 65_536
"""Size of an array [B] from which it is not copied into the encoded bytes."""


class Parts(bytearray):
    """Encoded bytes without large arrays, which are inserted at some positions.

    Attributes:
        blocks: position in these bytes, and the block to be inserted before it; its length is a
            multiple of eight, so that these bytes alone determine the alignment.
    """

    blocks: tuple[tuple[int, memoryview], ...] = ()

    def leave_out(self, view: memoryview) -> memoryview:
        """Register a large array; return its last bytes, which are not a multiple of eight."""
        whole = len(view) & ~7
        self.blocks += ((len(self), view[:whole]),)
        return view[whole:]

    def __iter__(self) -> Iterator[bytes | memoryview]:  # type: ignore[override]
        """All parts in order."""
        place = 0
        for after, view in self.blocks:
            yield bytes(memoryview(self)[place:after])
            yield view
            place = after
        yield bytes(memoryview(self)[place:])


WriteValue = Callable[[Any, bytearray], None]
"""Appends a value of one type, known only to its creator."""
Write = Callable[[object, bytearray], None]
"""Appends a message."""
_PACK_COUNT = tuple(one.pack for one in COUNT)


def wide_bytes(text: str) -> bytes:
    """UTF-16 units of a text, each in four bytes."""
    units = array.array("H", text.encode("utf-16-le", "surrogatepass"))
    return array.array("I", units).tobytes()


@cache
def writer(cls: type) -> Write:
    """Create the function that appends a message of a class. Raises CdrError."""
    steps: list[Write] = []
    pending: list[tuple[str, str]] = []
    _add_writes(cls, "", steps, pending)
    _end_run(steps, pending)
    if len(steps) == 1:
        return steps[0]

    def write(message: object, out: bytearray) -> None:
        for step in steps:
            step(message, out)

    return write


def _add_writes(cls: type, place: str, steps: list[Write], pending: list[tuple[str, str]]) -> None:
    members = members_of(cls)
    if not members:
        pending.append((EMPTY, ""))
    for name, slot in members:
        path = f"{place}{name}"
        if isinstance(slot, BasicType):
            pending.append((format_of(slot), path))
        elif isinstance(slot, NamespacedType):
            _add_writes(type_of(cls, slot), f"{path}.", steps, pending)
        else:
            _end_run(steps, pending)
            steps.append(_write_field(cls, path, slot))


def _end_run(steps: list[Write], pending: list[tuple[str, str]]) -> None:
    """Combine consecutive numbers into one step."""
    if not pending:
        return
    packs = [one.pack for one in PackedNumbers("".join(form for form, _ in pending)).at]
    paths = [path for _, path in pending if path]
    pending.clear()
    if len(paths) > 1:
        get = attrgetter(*paths)

        def write(message: object, out: bytearray) -> None:
            out += packs[len(out) & 7](*get(message))

    elif paths:
        get = attrgetter(paths[0])

        def write(message: object, out: bytearray) -> None:
            out += packs[len(out) & 7](get(message))

    else:

        def write(message: object, out: bytearray) -> None:
            out += packs[len(out) & 7]()

    steps.append(write)


def _write_field(cls: type, path: str, slot: object) -> Write:
    get = attrgetter(path)
    if isinstance(slot, UnboundedSequence) and isinstance(slot.value_type, BasicType):
        form = format_of(slot.value_type)
        if form in array.typecodes and slot.value_type.typename not in ("octet", "boolean"):
            return _write_array(get, form, _write_value(cls, path, slot))
    write = _write_value(cls, path, slot)

    def step(message: object, out: bytearray) -> None:
        write(get(message), out)

    return step


def _write_array(get: Callable[[object], Any], form: str, write: WriteValue) -> Write:
    """Create a step for an `array.array` of rosidl, with as few calls as possible."""
    size = calcsize(f"<{form}")
    most = LARGE // size
    padded = [f"<{-place % 4}xI{-(place + -place % 4 + 4) % size}x" for place in range(8)]
    packs = [Struct(one).pack for one in padded]

    def step(message: object, out: bytearray) -> None:
        value = get(message)
        count = len(value)
        if 0 < count < most and value.__class__ is array.array and value.typecode == form:
            out += packs[len(out) & 7](count)
            out += value
        else:
            write(value, out)

    return step


def _write_value(owner: type, name: str, slot: object) -> WriteValue:
    if isinstance(slot, AbstractGenericString):
        return _write_text(slot)
    if not isinstance(slot, AbstractNestedType):
        raise CdrError(f"{name}: no encoding of {type(slot).__name__}")
    check = length_check(slot, name.lstrip("_"))
    entries = _write_entries(owner, name, slot.value_type)
    has_count = isinstance(slot, AbstractSequence)

    def write(value: Any, out: bytearray) -> None:
        count = len(value)
        check(count)
        if has_count:
            out += _PACK_COUNT[len(out) & 7](count)
        if count:
            entries(value, out)

    return write


def _write_text(slot: AbstractGenericString) -> WriteValue:
    most = slot.maximum_size if slot.has_maximum_size() else sys.maxsize

    def write(value: str, out: bytearray) -> None:
        data = value.encode()
        count = len(data)
        if count > most:
            raise CdrError(f"a text of {count} bytes, the type allows {most}")
        out += _PACK_COUNT[len(out) & 7](count + 1) + data + b"\0"

    def write_wide(value: str, out: bytearray) -> None:
        data = wide_bytes(value)
        count = len(data) // WIDE
        if count > most:
            raise CdrError(f"a text of {count} units, the type allows {most}")
        out += _PACK_COUNT[len(out) & 7](count) + data

    return write_wide if isinstance(slot, AbstractWString) else write


def _write_texts(entries: Iterable[str], out: bytearray) -> None:
    for entry in entries:
        data = entry.encode() + b"\0"
        out += _PACK_COUNT[len(out) & 7](len(data)) + data


def _write_entries(owner: type, name: str, value: object) -> WriteValue:
    if isinstance(value, BasicType):
        return _write_numbers(value)
    one: WriteValue
    if isinstance(value, AbstractGenericString):
        if not value.has_maximum_size() and not isinstance(value, AbstractWString):
            return _write_texts
        one = _write_value(owner, name, value)
    else:
        one = writer(type_of(owner, value))

    def write(entries: Any, out: bytearray) -> None:
        for entry in entries:
            one(entry, out)

    return write


def _write_numbers(slot: BasicType) -> WriteValue:
    form = format_of(slot)
    size = calcsize(f"<{form}")
    if slot.typename == "octet":

        def write(entries: Any, out: bytearray) -> None:
            data = b"".join(entries)
            if len(data) != len(entries):
                raise CdrError("a byte that is not of length 1")
            out += data

    elif slot.typename == "boolean":

        def write(entries: Any, out: bytearray) -> None:
            out += bytes(map(bool, entries))

    else:

        def write(entries: Any, out: bytearray) -> None:
            out += bytes(-len(out) % size)
            is_block = isinstance(entries, array.array) and entries.typecode == form
            block: Any = entries if is_block else np.asarray(entries, form)
            view = memoryview(block).cast("B")
            if len(view) >= LARGE and isinstance(out, Parts):
                view = out.leave_out(view)
            out += view

    return write
