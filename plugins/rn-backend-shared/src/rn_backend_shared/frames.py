"""Frames between robots and servers: a header of fixed size, a JSON document and the arrays it
refers to, each bounded before memory is allocated.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from roboneuron import ForeignDataError, foreign

Document = dict[str, Any]
MAGIC = b"RNPI"
VERSION = 5
"""Protocol version. The first five bytes of a frame, magic and version, never change."""
MOST_DOCUMENT_BYTES = 1 << 18
MOST_ARRAY_BYTES = 1 << 26
MOST_LEFT_S = 3600.0
_MOST_ARRAYS = 64
_MOST_DIMENSIONS = 4
_HEADER = struct.Struct("!4sBBHQQIII")
HEADER_BYTES = _HEADER.size
_DTYPES = ("|u1", "<f8", "<i8", "<f4")
_ARRAY = "$array"
_MICRO = 1e6


class VersionError(ForeignDataError):
    """The other side uses another protocol version.

    Attributes:
        version: of the other side.
    """

    def __init__(self, version: int) -> None:
        super().__init__(
            f"the other side uses version {version} of the protocol of shared models, this side "
            f"version {VERSION}: install the same release of rn-backend-shared on both"
        )
        self.version = version


class FrameKind(IntEnum):
    """Kind of a frame."""

    HELLO = 1
    """Introduction of a robot."""
    WELCOME = 2
    """Description of the server and its model."""
    REQUEST = 3
    """An observation."""
    ANSWER = 4
    """A chunk, or an error."""
    STATUS = 5
    """Request or answer with a server's statistics; on local sockets only."""


class Header(NamedTuple):
    """The first bytes of a frame.

    Attributes:
        kind: kind of the frame.
        number: number of the request, one more than the previous one on the connection; an answer
            repeats it. A policy server's welcome names the one before the first.
        clock_ns: the robot's monotonic clock at the request; answer and welcome repeat it [ns].
        left_s: in a request, time after which the answer is useless [s]. A duration, because the
            clocks of two machines differ.
        document_bytes: size of the JSON document.
        array_bytes: size of the arrays after it.
    """

    kind: FrameKind
    number: int = 0
    clock_ns: int = 0
    left_s: float = 0.0
    document_bytes: int = 0
    array_bytes: int = 0

    @property
    def body_bytes(self) -> int:
        """Size of everything after the header."""
        return self.document_bytes + self.array_bytes

    def pack(self) -> bytes:
        """Encode the header."""
        left_us = round(min(max(self.left_s, 0.0), MOST_LEFT_S) * _MICRO)
        return _HEADER.pack(
            MAGIC,
            VERSION,
            self.kind,
            0,
            self.number,
            self.clock_ns,
            left_us,
            self.document_bytes,
            self.array_bytes,
        )


def read_header(data: bytes | bytearray) -> Header:
    """The header in `HEADER_BYTES` bytes.

    Raises:
        VersionError: the version differs.
        ForeignDataError: it is no header, or the sizes exceed the limits.
    """
    magic, version, kind, reserved, number, clock_ns, left_us, document, arrays = _HEADER.unpack(
        data
    )
    if magic != MAGIC:
        raise ForeignDataError("that is not the protocol of shared models")
    if version != VERSION:
        raise VersionError(version)
    if document > MOST_DOCUMENT_BYTES or arrays > MOST_ARRAY_BYTES:
        raise ForeignDataError(f"a frame of {document} and {arrays} bytes is more than allowed")
    if reserved or kind not in FrameKind.__members__.values() or left_us > MOST_LEFT_S * _MICRO:
        raise ForeignDataError("the header of a frame is damaged")
    return Header(FrameKind(kind), number, clock_ns, left_us / _MICRO, document, arrays)


def encode(header: Header, document: Mapping[str, object]) -> list[bytes | memoryview]:
    """Encode a document, with arrays anywhere in it, as the parts of a frame; arrays are not
    copied.

    Args:
        header: its sizes are filled in.

    Raises:
        ValueError: it is larger than allowed, or holds a number that is not finite outside arrays.
    """
    parts: list[NDArray[np.generic]] = []

    def default(value: object) -> object:
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{type(value).__name__} cannot be sent")
        parts.append(np.ascontiguousarray(value))
        return {_ARRAY: len(parts) - 1}

    text = json.dumps(document, default=default, allow_nan=False)
    heads = [[part.dtype.str, part.shape] for part in parts]
    body = f"[{text}, {json.dumps(heads)}]".encode()
    size = sum(part.nbytes for part in parts)
    if len(body) > MOST_DOCUMENT_BYTES or size > MOST_ARRAY_BYTES or len(parts) > _MOST_ARRAYS:
        raise ValueError(
            f"a document of {len(body)} bytes with {len(parts)} arrays of {size} bytes is more "
            "than can be sent"
        )
    filled = header._replace(document_bytes=len(body), array_bytes=size)
    tails = [part.reshape(-1).view(np.uint8).data for part in parts if part.size]
    return [filled.pack() + body, *tails]


def decode(header: Header, body: bytes | bytearray | memoryview) -> Document:
    """Decode the document of a frame; its arrays share the memory of `body`.

    Raises:
        ForeignDataError: it is malformed.
    """
    view, what = memoryview(body), "the document of a frame"
    told = foreign.decode_json(bytes(view[: header.document_bytes]), what)
    document, heads = foreign.items(told, "a frame", least=2, most=2)
    return foreign.table(_filled(document, _arrays(heads, view[header.document_bytes :])), what)


def _arrays(heads: object, data: memoryview) -> list[NDArray[np.generic]]:
    arrays: list[NDArray[np.generic]] = []
    offset = 0
    for head in foreign.items(heads, "the arrays of a frame", most=_MOST_ARRAYS):
        dtype, shape = foreign.items(head, "an array of a frame", least=2, most=2)
        if (
            dtype not in _DTYPES
            or not isinstance(shape, list)
            or len(shape) > _MOST_DIMENSIONS
            or any(type(n) is not int or not 0 <= n <= MOST_ARRAY_BYTES for n in shape)
        ):
            raise ForeignDataError(f"an array {dtype!r:.20} {shape!r:.60} is not expected")
        count = math.prod(shape)
        size = count * np.dtype(dtype).itemsize
        if offset + size > len(data):
            raise ForeignDataError("the frame ends within an array")
        arrays.append(np.frombuffer(data, dtype, count, offset).reshape(shape))
        offset += size
    if offset != len(data):
        raise ForeignDataError("bytes follow the arrays of a frame")
    return arrays


def _filled(value: object, arrays: list[NDArray[np.generic]]) -> object:
    if isinstance(value, dict):
        if value.keys() == {_ARRAY}:
            place = value[_ARRAY]
            if type(place) is not int or not 0 <= place < len(arrays):
                raise ForeignDataError("a document refers to an array that does not exist")
            return arrays[place]
        return {key: _filled(inner, arrays) for key, inner in value.items()}
    return [_filled(inner, arrays) for inner in value] if isinstance(value, list) else value
