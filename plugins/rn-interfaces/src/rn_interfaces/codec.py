"""CDR of a message class of rosidl, as Fast CDR writes it for ROS 2: plain XCDR1, little-endian.

Alignment counts from the first byte after the encapsulation header.

Sources: OMG DDS-XTypes 1.3, section 7.4 (XCDR1); the bytes of the compiled types, with which the
tests compare.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from struct import error as StructError
from typing import NamedTuple

from rn_interfaces.cdr_fields import CdrError
from rn_interfaces.cdr_reading import Bytes, reader
from rn_interfaces.cdr_writing import Parts, writer

_UNFIT = (StructError, TypeError, AttributeError, ValueError, IndexError, OverflowError)
"""Exceptions of encoding values of another type than the field's."""


class Codec(NamedTuple):
    """Encoder and decoder of one class."""

    encode: Callable[[object], bytes | Parts]
    """Message -> CDR without the encapsulation header; in parts if there is a large array. Raises
    CdrError.
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
    write = writer(cls)
    read = reader(cls)
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
            # The rest is padding: rmw_fastrtps assumes a message to be longer than it is.
            message, _ = read(data, 0, len(data))
        except (StructError, ValueError, IndexError, OverflowError) as error:
            raise CdrError(f"{len(data)} bytes are no {name}: {error}") from error
        return message

    return Codec(encode, decode)
