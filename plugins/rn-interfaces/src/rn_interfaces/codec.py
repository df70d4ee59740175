"""CDR of a message class of rosidl, as Fast CDR writes it for ROS 2: plain XCDR1, little-endian.

Functions that write and read one class are put together from its `SLOT_TYPES` once: fields of a
fixed size that follow each other are packed together, when written also those of nested messages.
Alignment counts from the first byte after the encapsulation header.

Sources: OMG DDS-XTypes 1.3, section 7.4 (XCDR1); the bytes of the compiled types, with which the
tests compare.
"""

from __future__ import annotations

import array
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from importlib import import_module
from operator import attrgetter
from struct import Struct, calcsize
from struct import error as StructError
from typing import Any, NamedTuple

import numpy as np
from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractNestedType,
    AbstractSequence,
    AbstractWString,
    Array,
    BasicType,
    BoundedSequence,
    NamespacedType,
    UnboundedSequence,
)

assert sys.byteorder == "little"  # as all platforms of the wheels are
FORMATS = {
    "boolean": "?",
    "octet": "c",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float": "f",
    "double": "d",
}
"""By the IDL name: the format of `struct`, which is the type code of `array` and numpy too; octets
are bytes of length 1."""
WIDE = 4
"""Bytes [B] of a UTF-16 unit of a wide text: Fast CDR writes a `wchar_t` each."""


class CdrError(ValueError):
    """Bytes that are no message of the type, or a message that its type has no bytes for."""


_UNFIT = (StructError, TypeError, AttributeError, ValueError, IndexError, OverflowError)
"""What values of other types than a field's raise when they are encoded."""
LARGE = 65_536
"""Size of an array [B] from which on it is not copied into what is encoded."""


class Parts(bytearray):
    """What is encoded but for large arrays, which follow at some places.

    Attributes:
        blocks: place in these bytes, and what is to stand before it; its length is a multiple of
            eight, so that these bytes alone tell the alignment.
    """

    blocks: tuple[tuple[int, memoryview], ...] = ()

    def leave_out(self, view: memoryview) -> memoryview:
        """Note a large array; returns its last bytes, which are no multiple of eight."""
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


Bytes = bytes | bytearray | memoryview
"""What is decoded; nothing that is decoded refers to it."""


class Codec(NamedTuple):
    """The two directions of one class."""

    encode: Callable[[object], bytes | Parts]
    """Message -> CDR without the encapsulation header; in parts where there is a large array.
    Raises CdrError.
    """
    decode: Callable[[Bytes], object]
    """CDR without the encapsulation header -> message. Raises CdrError."""


@cache
def codec(cls: type) -> Codec:
    """Return both directions of a message class.

    Raises
    ------
    CdrError
        The class has a field that ROS 2 has no encoding for here, such as `long double`.
    """
    write, read = _functions(cls)
    name = f"{cls.__module__.split('.')[0]}/{cls.__name__}"

    def encode(message: object) -> bytes | Parts:
        out = Parts()
        try:
            write(message, out)
        except _UNFIT as error:
            raise CdrError(f"this {name} cannot be encoded: {error}") from error
        return out if out.blocks else bytes(out)

    def decode(data: Bytes) -> object:
        try:
            # What follows is padding: rmw_fastrtps takes a message for longer than it becomes.
            message, _ = read(data, 0, len(data))
        except (StructError, ValueError, IndexError, OverflowError) as error:
            raise CdrError(f"{len(data)} bytes are no {name}: {error}") from error
        return message

    return Codec(encode, decode)


Write = Callable[[object, bytearray], None]
"""Appends a message."""
Read = Callable[[Bytes, int, int], tuple[Any, int]]
"""Of the bytes, a place and their end: a value, and the place after it."""


class Run:
    """Numbers that follow each other, by the place modulo eight at which the first one starts."""

    def __init__(self, formats: str) -> None:
        self.at = tuple(Struct(self._padded(formats, start)) for start in range(8))

    @staticmethod
    def _padded(formats: str, start: int) -> str:
        place = start
        parts = ["<"]
        for one in formats:
            size = calcsize(f"<{one}")
            gap = -place % size
            parts.append("x" * gap + one)
            place += gap + size
        return "".join(parts)


def type_of(owner: type, name: NamespacedType) -> type:
    """Return the class of a field's type. Those of a service or action are in its own module."""
    found = getattr(sys.modules[owner.__module__], name.name, None)
    if found is None or found.__module__.split(".")[:2] != list(name.namespaces):
        found = getattr(import_module(".".join(name.namespaces)), name.name)
    if not isinstance(found, type):
        raise CdrError(f"{'.'.join(name.namespaces)}.{name.name} is no message")
    return found


def wide_bytes(text: str) -> bytes:
    """UTF-16 units of a text, each in four bytes."""
    units = array.array("H", text.encode("utf-16-le", "surrogatepass"))
    return array.array("I", units).tobytes()


def wide_text(data: bytes | bytearray) -> str:
    """Raises OverflowError for a unit beyond UTF-16."""
    units = array.array("H", array.array("I", data))
    return units.tobytes().decode("utf-16-le", "replace")


COUNT = Run("I").at
_PACK_COUNT = tuple(one.pack for one in COUNT)
_CONTINUING = bytes(range(0x80, 0xC0))
"""Bytes of UTF-8 that continue a character."""
EMPTY = "x"
"""rosidl gives an empty structure one byte."""


@cache
def _functions(cls: type) -> tuple[Write, Read]:
    return _writing(cls), _reading(cls)


def _members(cls: type) -> list[tuple[str, object]]:
    fields = cls.get_fields_and_field_types()  # type: ignore[attr-defined]
    slots = cls.SLOT_TYPES  # type: ignore[attr-defined]
    return list(zip((f"_{name}" for name in fields), slots, strict=True))


def _format(slot: BasicType) -> str:
    if slot.typename not in FORMATS:
        raise CdrError(f"fields of type {slot.typename} have no encoding here")
    return FORMATS[slot.typename]


def number_size(slot: BasicType) -> int:
    """Size of a number [B], which is its alignment too. Raises CdrError."""
    return calcsize(f"<{_format(slot)}")


def _length_check(slot: AbstractNestedType, name: str) -> Callable[[int], None]:
    if isinstance(slot, Array):
        exact = slot.size

        def check(count: int) -> None:
            if count != exact:
                raise CdrError(f"{name} has {count} entries, not {exact}")

        return check
    most = slot.maximum_size if isinstance(slot, BoundedSequence) else sys.maxsize

    def check_most(count: int) -> None:
        if count > most:
            raise CdrError(f"{name} has {count} entries, more than {most}")

    return check_most


def _writing(cls: type) -> Write:
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
    members = _members(cls)
    if not members:
        pending.append((EMPTY, ""))
    for name, slot in members:
        path = f"{place}{name}"
        if isinstance(slot, BasicType):
            pending.append((_format(slot), path))
        elif isinstance(slot, NamespacedType):
            _add_writes(type_of(cls, slot), f"{path}.", steps, pending)
        else:
            _end_run(steps, pending)
            steps.append(_write_field(cls, path, slot))


def _end_run(steps: list[Write], pending: list[tuple[str, str]]) -> None:
    """Turn numbers that follow each other into one step."""
    if not pending:
        return
    packs = [one.pack for one in Run("".join(form for form, _ in pending)).at]
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
        form = _format(slot.value_type)
        if form in array.typecodes and slot.value_type.typename not in ("octet", "boolean"):
            return _write_array(get, form, _write_value(cls, path, slot))
    write = _write_value(cls, path, slot)

    def step(message: object, out: bytearray) -> None:
        write(get(message), out)

    return step


def _write_array(
    get: Callable[[object], Any], form: str, write: Callable[[Any, bytearray], None]
) -> Write:
    """A step for what rosidl keeps in an `array.array`, with as few calls as possible."""
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


def _write_value(owner: type, name: str, slot: object) -> Callable[[Any, bytearray], None]:
    if isinstance(slot, AbstractGenericString):
        return _write_text(slot)
    if not isinstance(slot, AbstractNestedType):
        raise CdrError(f"{name}: no encoding of {type(slot).__name__}")
    check = _length_check(slot, name.lstrip("_"))
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


def _write_text(slot: AbstractGenericString) -> Callable[[Any, bytearray], None]:
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


def _write_entries(owner: type, name: str, value: object) -> Callable[[Any, bytearray], None]:
    if isinstance(value, BasicType):
        return _write_numbers(value)
    one: Callable[[Any, bytearray], None]
    if isinstance(value, AbstractGenericString):
        if not value.has_maximum_size() and not isinstance(value, AbstractWString):
            return _write_texts
        one = _write_value(owner, name, value)
    else:
        one = _functions(type_of(owner, value))[0]

    def write(entries: Any, out: bytearray) -> None:
        for entry in entries:
            one(entry, out)

    return write


def _write_numbers(slot: BasicType) -> Callable[[Any, bytearray], None]:
    form = _format(slot)
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


def _reading(cls: type) -> Read:
    steps: list[Callable[[object, Bytes, int, int], int]] = []
    pending: list[tuple[str, str]] = []
    members = _members(cls)
    for name, slot in members or [("", None)]:
        if slot is None:
            pending.append((EMPTY, ""))
        elif isinstance(slot, BasicType):
            pending.append((_format(slot), name))
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


Step = Callable[[object, Bytes, int, int], int]


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
    runs = Run("".join(form for form, _ in pending)).at
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
        return _functions(type_of(owner, slot))[1]
    if isinstance(slot, AbstractGenericString):
        return _read_text(slot)
    if not isinstance(slot, AbstractNestedType):
        raise CdrError(f"{name}: no encoding of {type(slot).__name__}")
    entries = _read_entries(owner, name, slot)
    if isinstance(slot, Array):
        size = slot.size
        return lambda data, place, end: entries(data, place, end, size)
    check = _length_check(slot, name.lstrip("_"))

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
"""As Read, with the count behind."""


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
    form = _format(slot)
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
