"""openpi's wire format: msgpack, with numpy arrays as maps of byte-string keys. Nothing is ever
unpickled.

Source: openpi-client, msgpack_numpy (format only): {b"__ndarray__": True, b"data", b"dtype",
b"shape"} for arrays and {b"__npgeneric__": True, b"data", b"dtype"} for scalars; void, object and
complex types do not travel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from roboneuron import ConfigurationError

_KINDS = frozenset("biuf")
_MAX_DIMENSIONS = 8
Value = (
    str
    | bytes
    | int
    | float
    | bool
    | NDArray[Any]
    | np.generic
    | list[object]
    | Mapping[object, object]
    | None
)


def pack(value: Mapping[str, Value]) -> bytes:
    """Encode a map of strings, numbers, arrays, lists and maps.

    Raises:
        TypeError: something else is in it.
    """
    return bytes(msgpack.packb(value, default=_encode))


def unpack(data: bytes) -> dict[object, object]:
    """Decode one message.

    Raises:
        ConfigurationError: it is not msgpack, not a map, or an array in it is malformed.
    """
    try:
        value = msgpack.unpackb(data, object_hook=_decode, strict_map_key=True)
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise ConfigurationError(
            f"The policy server sent {len(data)} bytes that are not openpi's format: "
            f"{error or type(error).__name__}.",
            hint="Check that the URL is that of an openpi policy server.",
        ) from error
    if not isinstance(value, dict):
        raise ConfigurationError(
            f"The policy server sent a {type(value).__name__}, expected a map."
        )
    return value


def _encode(value: object) -> dict[bytes, object]:
    if not isinstance(value, np.ndarray | np.generic) or value.dtype.kind not in _KINDS:
        raise TypeError(f"{type(value).__name__} cannot be sent to a policy server")
    if isinstance(value, np.ndarray):
        shape = list(value.shape)
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": shape,
        }
    return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}


def _decode(value: dict[object, object]) -> object:
    if b"__ndarray__" in value:
        return _array(value)
    if b"__npgeneric__" in value:
        return _dtype(value.get(b"dtype")).type(value.get(b"data"))
    return value


def _dtype(name: object) -> np.dtype[Any]:
    if not isinstance(name, str):
        raise ValueError(f"dtype is {name!r}, expected text")
    dtype = np.dtype(name)
    if dtype.kind not in _KINDS:
        raise ValueError(f"dtype {name!r} is not a number type")
    return dtype


def _array(value: dict[object, object]) -> NDArray[Any]:
    dtype, shape, data = _dtype(value.get(b"dtype")), value.get(b"shape"), value.get(b"data")
    if not isinstance(data, bytes) or not isinstance(shape, list) or len(shape) > _MAX_DIMENSIONS:
        raise ValueError("an array lacks data or shape")
    if not all(isinstance(n, int) and n >= 0 for n in shape) or math.prod(
        shape
    ) * dtype.itemsize != len(data):
        raise ValueError(f"an array of {len(data)} bytes says it is {dtype} {shape}")
    return np.frombuffer(data, dtype=dtype).reshape(shape).copy()
