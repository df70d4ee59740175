"""openpi's wire format: msgpack, with numpy arrays as maps of byte-string keys. Nothing is ever
unpickled, and every size is bounded.

Source: openpi-client, msgpack_numpy (format only): {b"__ndarray__": True, b"data", b"dtype",
b"shape"} for arrays and {b"__npgeneric__": True, b"data", b"dtype"} for scalars; void, object and
complex types are not sent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from roboneuron import ForeignDataError, foreign

MOST_BYTES = 64 * 2**20
"""Limit of one message: four raw camera images of 2560 x 1600 and a state."""
MOST_DEPTH = 8
"""Limit of nested maps and lists; openpi's deepest observation has three."""
MOST_ITEMS = 1024
"""Limit of entries of one map or list."""
MOST_TEXT = 65536
"""Limit of characters of one text, for instance a prompt."""
Shape = tuple[int | None, ...]
_DTYPES = frozenset({"b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"})
_ORDERS = frozenset("<>|=")
_MOST_DIMENSIONS = 8
_MOST_SIDE = 2**31
Value = (
    str
    | bytes
    | int
    | float
    | bool
    | NDArray[np.generic]
    | np.generic
    | list[object]
    | Mapping[Any, object]
    | None
)


def pack(value: Value) -> bytes:
    """Encode strings, numbers, arrays, lists and maps.

    Raises:
        TypeError: the value contains something else.
    """
    packed: bytes = msgpack.packb(value, default=_encode)
    return packed


def unpack(data: bytes) -> dict[object, object] | NDArray[np.generic]:
    """Decode one message: a map, or an array alone.

    Raises:
        ForeignDataError: it is not msgpack, neither a map nor an array, larger or deeper than the
            bounds, or contains a malformed array.
    """
    if len(data) > MOST_BYTES:
        raise ForeignDataError(f"A message has {len(data)} bytes, at most {MOST_BYTES} are read.")
    try:
        value = msgpack.unpackb(
            data,
            object_hook=_decode,
            strict_map_key=True,
            max_array_len=MOST_ITEMS,
            max_map_len=MOST_ITEMS,
            max_str_len=MOST_TEXT,
            max_ext_len=0,
        )
    except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
        raise ForeignDataError(
            f"A message of {len(data)} bytes is not in openpi's format: "
            f"{error or type(error).__name__}."
        ) from error
    foreign.check_value(value, "a message in openpi's format", most_depth=MOST_DEPTH)
    if not isinstance(value, dict | np.ndarray):
        raise ForeignDataError(
            f"A message holds a {type(value).__name__}, expected a map or an array."
        )
    return value


def _encode(value: object) -> dict[bytes, object]:
    if not isinstance(value, np.ndarray | np.generic) or value.dtype.str[1:] not in _DTYPES:
        raise TypeError(f"{type(value).__name__} cannot be encoded in openpi's format")
    if isinstance(value, np.ndarray):
        shape = list(value.shape)
        return {
            b"__ndarray__": True,
            b"data": np.ascontiguousarray(value).data,
            b"dtype": value.dtype.str,
            b"shape": shape,
        }
    return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}


def _decode(value: dict[object, object]) -> object:
    if b"__ndarray__" in value:
        return _array(value)
    if b"__npgeneric__" in value:
        return _scalar(value)
    return value


def _scalar(value: dict[object, object]) -> np.generic:
    data = value.get(b"data")
    if not isinstance(data, bool | int | float):
        raise ValueError(f"a scalar holds a {type(data).__name__}")
    with np.errstate(over="ignore"):  # it becomes infinite, which the contract refuses
        scalar: np.generic = _dtype(value.get(b"dtype")).type(data)
    return scalar


def _dtype(name: object) -> np.dtype[np.generic]:
    if not isinstance(name, str):
        raise ValueError(f"dtype is {name!r}, expected text")
    # numpy would take ",f8" for a list of types
    if name[:1] not in _ORDERS or name[1:] not in _DTYPES:
        raise ValueError(f"dtype {name!r} is not a number type")
    return np.dtype(name)


def _array(value: dict[object, object]) -> NDArray[np.generic]:
    dtype, shape, data = _dtype(value.get(b"dtype")), value.get(b"shape"), value.get(b"data")
    if not isinstance(data, bytes) or not isinstance(shape, list) or len(shape) > _MOST_DIMENSIONS:
        raise ValueError("an array lacks data or shape")
    is_shape = all(type(side) is int and 0 <= side < _MOST_SIDE for side in shape)
    if not is_shape or math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"an array of {len(data)} bytes says it is {dtype} {shape}")
    return np.frombuffer(data, dtype=dtype).reshape(shape).copy()


def array(value: object, what: str, dtype: str, shape: Shape) -> NDArray[Any]:
    """A received array; None in `shape` stands for any length. Raises ForeignDataError."""
    if (
        not isinstance(value, np.ndarray)
        or value.dtype.str != dtype
        or value.ndim != len(shape)
        or any(n not in (None, m) for n, m in zip(shape, value.shape, strict=True))
    ):
        raise ForeignDataError(f"{what} is no array {dtype} {shape}")
    return value


def numbers(value: object, what: str, shape: Shape) -> NDArray[np.float64]:
    """Finite float64 numbers."""
    found: NDArray[np.float64] = array(value, what, "<f8", shape)
    if not np.isfinite(found).all():
        raise ForeignDataError(f"{what} holds numbers that are not finite")
    return found
