"""Encoders of arrays: from lists and base64 to rosidl's containers (array.array, numpy arrays,
lists).
"""

from __future__ import annotations

import base64
import binascii
import math
from array import array
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron.tools.ros.interfaces.description import FLOAT32_MAX, Array, FieldChoice, Scalar
from roboneuron.tools.ros.interfaces.refusal import Mismatch, describe_value
from roboneuron.tools.ros.interfaces.scalars import (
    NONFINITE_NAMES,
    Budget,
    Encoder,
    make_scalar_encoder,
)

TYPECODES = {
    "float": "f", "double": "d",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
}  # fmt: skip
"""array.array type codes as rosidl_generator_py uses them."""

DTYPES = {
    "float": np.float32, "double": np.float64,
    "int8": np.int8, "uint8": np.uint8, "int16": np.int16, "uint16": np.uint16,
    "int32": np.int32, "uint32": np.uint32, "int64": np.int64, "uint64": np.uint64,
}  # fmt: skip
"""numpy types of fixed arrays, likewise."""


def make_array_encoder(shape: Array, element: Encoder) -> Encoder:
    """Return a function (value, budget) -> list, array.array or numpy array of exactly the allowed
    length.

    Args:
        shape: the array's description.
        element: encodes one element; called for each, except where whole lists of numbers are
            checked at once.
    """
    check_length = _make_length_check(shape)
    scalar = shape.element if isinstance(shape.element, Scalar) else None
    pack = _make_packer(shape, scalar)
    fast = _make_bulk_encoder(scalar) if scalar is not None and scalar.ros in TYPECODES else None
    unpack_bytes = (
        (lambda raw: [bytes((b,)) for b in raw]) if scalar and scalar.ros == "octet" else list
    )
    kinds = describe_shape(shape)

    def encode(value: object, budget: Budget) -> object:
        if value.__class__ is not list and not isinstance(value, list | tuple):
            if not shape.is_bytes or not isinstance(value, str):
                raise Mismatch(describe_value(value), kinds)
            raw = _decode_base64(value, budget.limits.binary_bytes)
            check_length(len(raw))
            return pack(raw if fast is not None else unpack_bytes(raw))
        check_length(len(value))
        budget.take(len(value))
        if fast is not None:
            packed = fast(value)
            if packed is not None:
                return pack(packed)
        items = []
        for index, item in enumerate(value):
            try:
                items.append(element(item, budget))
            except Mismatch as mismatch:
                mismatch.steps.append(index)
                raise
        return pack(items)

    return encode


def describe_shape(shape: Array) -> str:
    """Describe the accepted values of an array field in a few words."""
    if shape.size is None:
        length = "a list"
    elif shape.fixed:
        length = f"a list of exactly {shape.size}"
    else:
        length = f"a list of at most {shape.size}"
    if shape.is_bytes:
        return f"{length} integers 0..255, or the bytes as base64 text"
    return length


def _make_length_check(shape: Array) -> Callable[[int], None]:
    size, fixed, allowed = shape.size, shape.fixed, describe_shape(shape)

    def check(length: int) -> None:
        if size is not None and (length != size if fixed else length > size):
            raise Mismatch(f"{length} elements", allowed)

    return check


def _make_packer(shape: Array, scalar: Scalar | None) -> Callable[[Any], Any]:
    """The container that rosidl's C conversion expects."""
    if scalar is None or scalar.ros not in TYPECODES:
        return lambda items: items
    if shape.fixed:
        dtype = DTYPES[scalar.ros]
        if scalar.ros == "uint8":
            return lambda items: np.array(
                list(items) if isinstance(items, bytes) else items, dtype=np.uint8
            )
        return lambda items: np.array(items, dtype=dtype)
    code = TYPECODES[scalar.ros]
    return lambda items: items if isinstance(items, array) else array(code, items)


def _make_bulk_encoder(scalar: Scalar) -> Callable[[Sequence[Any]], Any]:
    """Check a whole list of numbers in C; None means that each element has to be checked, to find
    an error or a special value.
    """
    code = TYPECODES[scalar.ros]
    if scalar.is_integer:

        def encode_integers(values: Sequence[Any]) -> Any:
            if set(map(type, values)) <= {int}:
                try:
                    return array(code, values)
                except OverflowError:
                    return None
            return None

        return encode_integers

    limit = FLOAT32_MAX if scalar.ros == "float" else math.inf

    def encode_floats(values: Sequence[Any]) -> Any:
        if not set(map(type, values)) <= {int, float}:
            return None
        try:
            packed = array("d", values)
        except OverflowError:
            return None
        numbers = np.frombuffer(packed) if len(packed) else None
        if numbers is not None and not (
            np.isfinite(numbers).all() and (limit == math.inf or _within(numbers, limit))
        ):
            return None
        return packed if code == "d" else array(code, packed)

    return encode_floats


def _within(numbers: NDArray[np.float64], limit: float) -> bool:
    return bool(-limit <= numbers.min() and numbers.max() <= limit)


def _decode_base64(text: str, longest: int) -> bytes:
    # "Infinity" would be valid base64 of six bytes, but means the number
    if text in NONFINITE_NAMES:
        raise Mismatch(describe_value(text), "a list of integers 0..255 or valid base64 text")
    if len(text) > (longest // 3 + 1) * 4:
        raise Mismatch(f"a base64 text of {len(text)} characters", f"at most {longest} bytes")
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise Mismatch(
            describe_value(text), "a list of integers 0..255 or valid base64 text"
        ) from None


def make_list_encoder(shape: Array, choices: tuple[FieldChoice, ...] = ()) -> Encoder:
    """Return the encoder of an array of single values."""
    assert isinstance(shape.element, Scalar)
    return make_array_encoder(shape, make_scalar_encoder(shape.element, choices))
