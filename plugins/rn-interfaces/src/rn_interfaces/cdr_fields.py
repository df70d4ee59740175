"""Fields of a message class as CDR has them: what writing and reading share.

Source: OMG DDS-XTypes 1.3, section 7.4 (XCDR1).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from struct import Struct, calcsize

from rosidl_parser.definition import (
    AbstractNestedType,
    Array,
    BasicType,
    BoundedSequence,
    NamespacedType,
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


class PackedNumbers:
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


COUNT = PackedNumbers("I").at
EMPTY = "x"
"""rosidl gives an empty structure one byte."""


def members_of(cls: type) -> list[tuple[str, object]]:
    """Attribute and type of each field, in order."""
    fields = cls.get_fields_and_field_types()  # type: ignore[attr-defined]
    slots = cls.SLOT_TYPES  # type: ignore[attr-defined]
    return list(zip((f"_{name}" for name in fields), slots, strict=True))


def format_of(slot: BasicType) -> str:
    """Format of a number for `struct`. Raises CdrError for one without."""
    if slot.typename not in FORMATS:
        raise CdrError(f"fields of type {slot.typename} have no encoding here")
    return FORMATS[slot.typename]


def number_size(slot: BasicType) -> int:
    """Size of a number [B], which is its alignment too. Raises CdrError."""
    return calcsize(f"<{format_of(slot)}")


def length_check(slot: AbstractNestedType, name: str) -> Callable[[int], None]:
    """A function that raises CdrError for a number of entries that a field cannot have."""
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
