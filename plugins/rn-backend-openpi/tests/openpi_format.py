"""openpi's format of arrays, written from its description without the code under test."""

from __future__ import annotations

from typing import Any

import numpy as np


def encode(value: Any) -> dict[bytes, Any]:
    """Encode numpy values in openpi's format."""
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}


def decode(value: dict[Any, Any]) -> Any:
    """The reverse of `encode`."""
    if b"__ndarray__" in value:
        return np.ndarray(
            buffer=value[b"data"], dtype=np.dtype(value[b"dtype"]), shape=value[b"shape"]
        )
    return value
