"""CDR of a message class of rosidl, as Fast CDR writes it for ROS 2: plain XCDR1, little-endian.

Functions that write and read one class are made from its `SLOT_TYPES` once, as source text, as
dataclasses make theirs: fields of a fixed size, those of nested messages among them, are packed
together. Alignment counts from the first byte after the encapsulation header.

Sources: OMG DDS-XTypes 1.3, section 7.4 (XCDR1); the bytes of the compiled types, with which the
tests compare.
"""

from __future__ import annotations

import array
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from struct import Struct, calcsize
from struct import error as StructError
from typing import NamedTuple

import numpy as np
from rosidl_parser.definition import (  # type: ignore[import-untyped]
    AbstractGenericString,
    AbstractNestedType,
    AbstractSequence,
    AbstractWString,
    Array,
    BasicType,
    BoundedSequence,
    NamespacedType,
)

assert sys.byteorder == "little"  # as all platforms of the wheels are
FORMATS = {
    "boolean": "?",
    "octet": "B",
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
"""By the IDL name: the format of `struct`, which is the type code of `array` and numpy too."""
LISTED = frozenset({"boolean", "octet"})
"""Of which rosidl's Python classes keep lists; all other numbers are in arrays."""
WIDE = 4
"""Bytes [B] of a UTF-16 unit of a wide text: Fast CDR writes a `wchar_t` each."""


class CdrError(ValueError):
    """Bytes that are no message of the type, or a message that its type has no bytes for."""


class Codec(NamedTuple):
    """The two directions of one class."""

    encode: Callable[[object], bytes]
    """Message -> CDR without the encapsulation header. Raises CdrError."""
    decode: Callable[[bytes], object]
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

    def encode(message: object) -> bytes:
        out = bytearray()
        try:
            write(message, out)
        except (StructError, TypeError, AttributeError, ValueError, IndexError) as error:
            raise CdrError(f"this {name} cannot be encoded: {error}") from error
        return bytes(out)

    def decode(data: bytes) -> object:
        try:
            # What follows is padding: rmw_fastrtps takes a message for longer than it becomes.
            message, _ = read(data, 0, len(data))
        except (StructError, ValueError, IndexError, OverflowError) as error:
            raise CdrError(f"{len(data)} bytes are no {name}: {error}") from error
        return message

    return Codec(encode, decode)


Write = Callable[[object, bytearray], None]
Read = Callable[[bytes, int, int], tuple[object, int]]


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
    if found is None or found.__module__.split(".")[0] != name.namespaces[0]:
        found = getattr(import_module(".".join(name.namespaces)), name.name)
    if not isinstance(found, type):
        raise CdrError(f"{'.'.join(name.namespaces)}.{name.name} is no message")
    return found


def wide_bytes(text: str) -> bytes:
    """UTF-16 units of a text, each in four bytes."""
    units = array.array("H", text.encode("utf-16-le", "surrogatepass"))
    return array.array("I", units).tobytes()


def wide_text(data: bytes) -> str:
    """Raises OverflowError for a unit beyond UTF-16."""
    units = array.array("H", array.array("I", data))
    return units.tobytes().decode("utf-16-le", "replace")


class _Source:
    """Source text of one function, and the objects that it uses by name."""

    def __init__(self, head: str) -> None:
        self.lines = [head]
        self.names: dict[str, object] = {
            "CdrError": CdrError,
            "array": array.array,
            "np": np,
            "wide_bytes": wide_bytes,
            "wide_text": wide_text,
        }

    def add(self, *lines: str, depth: int = 1) -> None:
        self.lines.extend("    " * depth + line for line in lines)

    def name(self, value: object, stem: str) -> str:
        """Return a name of a value in the function."""
        text = f"{stem}{len(self.names)}"
        self.names[text] = value
        return text

    def compile(self) -> object:
        scope = dict(self.names)
        exec("\n".join(self.lines), scope)  # noqa: S102  (text of this module alone)
        return scope["function"]


@cache
def _functions(cls: type) -> tuple[Write, Read]:
    return _Writing(cls).function(), _Reading(cls).function()


def _members(cls: type) -> list[tuple[str, object]]:
    fields = cls.get_fields_and_field_types()  # type: ignore[attr-defined]
    slots = cls.SLOT_TYPES  # type: ignore[attr-defined]
    return list(zip((f"_{name}" for name in fields), slots, strict=True))


def _format(slot: BasicType) -> str:
    if slot.typename not in FORMATS:
        raise CdrError(f"fields of type {slot.typename} have no encoding here")
    return FORMATS[slot.typename]


def _length_lines(slot: object, what: str) -> list[str]:
    bound = slot.maximum_size if isinstance(slot, BoundedSequence) else None
    if isinstance(slot, Array):
        bound = slot.size
    if bound is None:
        return []
    sign, words = ("!=", "not") if isinstance(slot, Array) else (">", "more than")
    text = f"{what[2:] or what} has {{n}} entries, {words} {bound}"
    return [f"if n {sign} {bound}: raise CdrError(f{text!r})"]


class _Writing:
    def __init__(self, cls: type) -> None:
        self._cls = cls
        self._source = _Source("def function(m, out):")
        self._formats = ""
        self._values: list[str] = []

    def function(self) -> Write:
        self._message(self._cls, "m")
        self._flush()
        self._source.add("return None")
        return self._source.compile()  # type: ignore[return-value]

    def _message(self, cls: type, place: str) -> None:
        members = _members(cls)
        if not members:  # rosidl gives an empty structure one byte
            self._number("B", "0")
        for name, slot in members:
            self._field(cls, f"{place}.{name}", slot)

    def _number(self, form: str, value: str) -> None:
        self._formats += form
        self._values.append(value)

    def _flush(self) -> None:
        if self._formats:
            run = self._source.name(Run(self._formats).at, "run")
            self._source.add(f"out += {run}[len(out) & 7].pack({', '.join(self._values)})")
        self._formats, self._values = "", []

    def _field(self, owner: type, place: str, slot: object) -> None:
        if isinstance(slot, BasicType):
            value = f"{place}[0]" if slot.typename == "octet" else place
            self._number(_format(slot), value)
        elif isinstance(slot, NamespacedType):
            self._message(type_of(owner, slot), place)
        elif isinstance(slot, AbstractGenericString):
            self._flush()
            self._text(place, slot, 1)
        elif isinstance(slot, AbstractNestedType):
            self._flush()
            self._entries(owner, place, slot)
        else:
            raise CdrError(f"{place}: no encoding of {type(slot).__name__}")

    def _text(self, value: str, slot: AbstractGenericString, depth: int) -> None:
        head = self._source.name(Run("I").at, "head")
        add = self._source.add
        if isinstance(slot, AbstractWString):
            add(f"t = wide_bytes({value})", f"n = len(t) // {WIDE}", depth=depth)
        else:
            add(f"t = {value}.encode() + b'\\0'", "n = len(t) - 1", depth=depth)
        if slot.has_maximum_size():
            text = f"a text of {{n}} bytes, the type allows {slot.maximum_size}"
            add(f"if n > {slot.maximum_size}: raise CdrError(f{text!r})", depth=depth)
        count = "n" if isinstance(slot, AbstractWString) else "n + 1"
        add(f"out += {head}[len(out) & 7].pack({count})", "out += t", depth=depth)

    def _entries(self, owner: type, place: str, slot: AbstractNestedType) -> None:
        add = self._source.add
        value = slot.value_type
        add(f"v = {place}", "n = len(v)", *_length_lines(slot, place))
        if isinstance(slot, AbstractSequence):
            head = self._source.name(Run("I").at, "head")
            add(f"out += {head}[len(out) & 7].pack(n)")
        if isinstance(value, BasicType):
            form = _format(value)
            if value.typename == "octet":
                add("out += b''.join(v)")
            elif value.typename == "boolean":
                add("out += bytes(map(bool, v))")
            else:
                add(f"if n: out += bytes(-len(out) % {calcsize('<' + form)})")
                add(f"out += memoryview(v if hasattr(v, 'tobytes') else array({form!r}, v))")
        elif isinstance(value, AbstractGenericString):
            add("for one in v:")
            self._text("one", value, 2)
        else:
            write = self._source.name(_functions(type_of(owner, value))[0], "write")
            add("for one in v:", f"    {write}(one, out)")


class _Reading:
    def __init__(self, cls: type) -> None:
        self._cls = cls
        self._source = _Source("def function(b, p, end):")
        self._formats = ""
        self._targets: list[tuple[str, bool]] = []
        self._count = 0

    def function(self) -> Read:
        self._source.names["view"] = memoryview
        self._message(self._cls, "m")
        self._flush()
        self._source.add("return m, p")
        return self._source.compile()  # type: ignore[return-value]

    def _message(self, cls: type, place: str) -> None:
        made = self._source.name(cls, "cls")
        # __new__ alone: __init__ would fill and check each field first
        self._source.add(f"{place} = {made}.__new__({made})", f"{place}._check_fields = False")
        members = _members(cls)
        if not members:
            self._number("B", "_")
        for name, slot in members:
            self._field(cls, f"{place}.{name}", slot)

    def _number(self, form: str, target: str, *, is_octet: bool = False) -> None:
        self._formats += form
        self._targets.append((target, is_octet))

    def _flush(self) -> None:
        if self._formats:
            run = self._source.name(Run(self._formats).at, "run")
            targets = ", ".join(target for target, _ in self._targets)
            self._source.add(
                f"s = {run}[p & 7]",
                f"{targets}, = s.unpack_from(b, p)",
                "p += s.size",
            )
            for target, is_octet in self._targets:
                if is_octet:
                    self._source.add(f"{target} = bytes(({target},))")
        self._formats, self._targets = "", []

    def _field(self, owner: type, place: str, slot: object) -> None:
        if isinstance(slot, BasicType):
            self._number(_format(slot), place, is_octet=slot.typename == "octet")
        elif isinstance(slot, NamespacedType):
            self._count += 1
            inner = f"m{self._count}"
            self._message(type_of(owner, slot), inner)
            self._source.add(f"{place} = {inner}")
        elif isinstance(slot, AbstractGenericString):
            self._flush()
            self._text(place, slot, 1)
        elif isinstance(slot, AbstractNestedType):
            self._flush()
            self._entries(owner, place, slot)
        else:
            raise CdrError(f"{place}: no encoding of {type(slot).__name__}")

    def _length(self, depth: int) -> None:
        head = self._source.name(Run("I").at, "head")
        self._source.add(
            f"s = {head}[p & 7]", "n, = s.unpack_from(b, p)", "p += s.size", depth=depth
        )

    def _room(self, size: int, depth: int) -> None:
        text = "an entry of {n} elements is longer than the rest of the message"
        amount = "n" if size == 1 else f"n * {size}"
        self._source.add(f"if {amount} > end - p: raise CdrError(f{text!r})", depth=depth)

    def _text(self, target: str, slot: AbstractGenericString, depth: int) -> None:
        add = self._source.add
        self._length(depth)
        wide = isinstance(slot, AbstractWString)
        self._room(WIDE if wide else 1, depth)
        if wide:
            add(f"{target} = wide_text(b[p:p + n * {WIDE}])", f"p += n * {WIDE}", depth=depth)
        else:
            # some vendors send an empty text without its closing zero
            add(f"{target} = str(b[p:p + n - 1], 'utf-8', 'replace') if n else ''", depth=depth)
            add("p += n", depth=depth)
        if slot.has_maximum_size():
            text = f"a text of {{len({target})}} characters, the type allows {slot.maximum_size}"
            add(
                f"if len({target}) > {slot.maximum_size}: raise CdrError(f{text!r})", depth=depth
            )

    def _entries(self, owner: type, place: str, slot: AbstractNestedType) -> None:
        add = self._source.add
        value = slot.value_type
        if isinstance(slot, AbstractSequence):
            self._length(1)
            add(*_length_lines(slot, place))
        else:
            add(f"n = {slot.size}")
        if isinstance(value, BasicType):
            form = _format(value)
            size = calcsize(f"<{form}")
            if size > 1:
                add(f"if n: p += -p % {size}")
            self._room(size, 1)
            data = f"view(b)[p:p + n * {size}]"
            if value.typename == "octet":
                add(f"{place} = [bytes((one,)) for one in b[p:p + n]]")
            elif value.typename == "boolean":
                add(f"{place} = [bool(one) for one in b[p:p + n]]")
            elif isinstance(slot, Array):
                add(f"{place} = np.frombuffer({data}, {np.dtype(form).str!r}).copy()")
            else:
                add(f"v = array({form!r})", f"v.frombytes({data})", f"{place} = v")
            add(f"p += n * {size}")
        elif isinstance(value, AbstractGenericString):
            self._room(1, 1)
            add("v = []", "for _ in range(n):")
            self._text("one", value, 2)
            add("    v.append(one)", f"{place} = v")
        else:
            self._room(1, 1)
            read = self._source.name(_functions(type_of(owner, value))[1], "read")
            add("v = []", "for _ in range(n):", f"    one, p = {read}(b, p, end)")
            add("    v.append(one)", f"{place} = v")
