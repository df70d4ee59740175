"""Checked access to the fields of received documents: that of `roboneuron.foreign`, and arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron import ForeignDataError, foreign

Shape = tuple[int | None, ...]
MOST_TEXT = foreign.MOST_TEXT
field, table, items, text = foreign.field, foreign.table, foreign.items, foreign.text
integer, number, optional_number = foreign.integer, foreign.number, foreign.optional_number
truth, named_numbers = foreign.truth, foreign.named_numbers


def array(value: object, what: str, dtype: str, shape: Shape) -> NDArray[Any]:
    """An array; None in `shape` stands for any length."""
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
