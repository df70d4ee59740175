"""Checked access to the fields of received documents: each must have the type and range of the
contract.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rn_backend_shared.frames import Document, FrameError

MOST_TEXT = 16384
"""Limit of characters of an instruction or a message."""
_INT64 = 1 << 63
Shape = tuple[int | None, ...]


def field(document: object, name: str) -> Any:
    """A required field."""
    if not isinstance(document, dict) or name not in document:
        raise FrameError(f"{name!r} is missing")
    return document[name]


def table(value: object, what: str, most: int) -> Document:
    """A table of at most `most` entries."""
    if not isinstance(value, dict) or len(value) > most:
        raise FrameError(f"{what} is no table of at most {most} entries")
    return value


def items(value: object, what: str, *, most: int, least: int = 0) -> list[object]:
    """A list of `least` to `most` entries."""
    if not isinstance(value, list) or not least <= len(value) <= most:
        raise FrameError(f"{what} is no list of {least} to {most}")
    return value


def text(value: object, what: str, most: int = 256) -> str:
    """Text."""
    if not isinstance(value, str) or len(value) > most:
        raise FrameError(f"{what} is no text of at most {most} characters")
    return value


def integer(value: object, what: str, low: int = -_INT64, high: int = _INT64 - 1) -> int:
    """An integer in a range."""
    if type(value) is not int or not low <= value <= high:
        raise FrameError(f"{what} is no integer in {low} .. {high}")
    return value


def number(value: object, what: str, low: float = -math.inf) -> float:
    """A finite number, at least `low`."""
    if type(value) not in (int, float) or not math.isfinite(cast("float", value)):
        raise FrameError(f"{what} is no finite number")
    found = float(cast("float", value))
    if found < low:
        raise FrameError(f"{what} is {found:g}, expected {low:g} at least")
    return found


def optional_number(value: object, what: str) -> float | None:
    """A finite number, or None."""
    return None if value is None else number(value, what)


def truth(value: object, what: str) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise FrameError(f"{what} is neither true nor false")
    return value


def array(value: object, what: str, dtype: str, shape: Shape) -> NDArray[Any]:
    """An array; None in `shape` stands for any length."""
    if (
        not isinstance(value, np.ndarray)
        or value.dtype.str != dtype
        or value.ndim != len(shape)
        or any(n not in (None, m) for n, m in zip(shape, value.shape, strict=True))
    ):
        raise FrameError(f"{what} is no array {dtype} {shape}")
    return value


def numbers(value: object, what: str, shape: Shape) -> NDArray[np.float64]:
    """Finite float64 numbers."""
    found: NDArray[np.float64] = array(value, what, "<f8", shape)
    if not np.isfinite(found).all():
        raise FrameError(f"{what} holds numbers that are not finite")
    return found


def named_numbers(value: object, what: str, most: int) -> Mapping[str, float]:
    """Finite numbers by name."""
    found = table(value, what, most)
    return {text(name, what, 64): number(one, f"{what}.{name}") for name, one in found.items()}
