"""CDR layout of a message class's fields, shared by writing and reading.

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

assert sys.byteorder == "little"  # as on all platforms of the wheels
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
"""Size of a UTF-16 unit of a wide text [B]: Fast CDR writes a `wchar_t` each."""


class CdrError(ValueError):
    """Invalid bytes for the type, or a message that cannot be encoded."""


class PackedNumbers:
    """Consecutive numbers, by the position modulo eight of the first one."""

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
    """Return the class of a field's type. Parts of a service or action are in its own module."""
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
    """Format of a number for `struct`. Raises CdrError for a type without one."""
    if slot.typename not in FORMATS:
        raise CdrError(f"fields of type {slot.typename} have no encoding here")
    return FORMATS[slot.typename]


def number_size(slot: BasicType) -> int:
    """Size of a number [B], which is also its alignment. Raises CdrError."""
    return calcsize(f"<{format_of(slot)}")


def length_check(slot: AbstractNestedType, name: str) -> Callable[[int], None]:
    """Create a function that raises CdrError for an invalid number of entries."""
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
