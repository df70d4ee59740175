"""Program with which native.c checks CDR: the fields of a message class as operations with two
operands.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from functools import cache

from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractWString,
    Array,
    BasicType,
    BoundedSequence,
)

from rn_interfaces.cdr_fields import WIDE, number_size, type_of

END, NUMBERS, NUMBER_SEQUENCE, TEXT, ARRAY, SEQUENCE = range(6)
ANY = (1 << 63) - 1
"""Operand without a bound."""


@cache
def program(cls: type) -> ctypes.Array[ctypes.c_int64]:
    """The operations of a class; they live as long as the process.

    Raises
    ------
    CdrError
        The class has a field that has no encoding here.
    """
    slots = cls.SLOT_TYPES  # type: ignore[attr-defined]
    words = [word for slot in slots for word in _operation(cls, slot)]
    if not slots:
        words = [NUMBERS, 1, 1]  # rosidl gives an empty structure one byte
    return _array([*words, END, 0, 0])


@cache
def _text(unit: int, most: int) -> ctypes.Array[ctypes.c_int64]:
    return _array([TEXT, unit, most, END, 0, 0])


def _array(words: list[int]) -> ctypes.Array[ctypes.c_int64]:
    return (ctypes.c_int64 * len(words))(*words)


def _operation(owner: type, slot: object) -> Iterator[int]:
    if isinstance(slot, BasicType):
        yield from (NUMBERS, number_size(slot), 1)
    elif isinstance(slot, AbstractGenericString):
        yield from (TEXT, *_text_operands(slot))
    elif isinstance(slot, Array):
        if isinstance(slot.value_type, BasicType):
            yield from (NUMBERS, number_size(slot.value_type), slot.size)
        else:
            yield from (ARRAY, slot.size, _address(owner, slot.value_type))
    elif hasattr(slot, "value_type"):
        most = slot.maximum_size if isinstance(slot, BoundedSequence) else ANY
        if isinstance(slot.value_type, BasicType):
            yield from (NUMBER_SEQUENCE, number_size(slot.value_type), most)
        else:
            yield from (SEQUENCE, most, _address(owner, slot.value_type))
    else:
        yield from (ARRAY, 1, _address(owner, slot))


def _text_operands(slot: AbstractGenericString) -> tuple[int, int]:
    unit = WIDE if isinstance(slot, AbstractWString) else 1
    return unit, slot.maximum_size if slot.has_maximum_size() else ANY


def _address(owner: type, entry: object) -> int:
    if isinstance(entry, AbstractGenericString):
        return ctypes.addressof(_text(*_text_operands(entry)))
    return ctypes.addressof(program(type_of(owner, entry)))
