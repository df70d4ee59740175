"""Values as plain data, to detect modifications and to compare answers."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass

import numpy as np

ATOL, RTOL = 1e-6, 1e-4
"""Tolerances of `is_alike`, for rounding between two runs of the same computation on one
machine.
"""
_PLAIN = (type(None), bool, int, str, bytes, range)


def snapshot(value: object, _seen: frozenset[int] = frozenset()) -> object:
    """Comparable plain data of `value` and its contents; functions by identity, arrays by
    content.
    """
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, float):
        return "float", repr(value)
    if id(value) in _seen:
        return "..."
    seen = _seen | {id(value)}
    if hasattr(value, "__array__") and not isinstance(value, type):
        return _array(value)
    if isinstance(value, Mapping):
        return "map", tuple((repr(key), snapshot(item, seen)) for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return type(value).__name__, tuple(snapshot(item, seen) for item in value)
    if isinstance(value, (set, frozenset)):
        return "set", tuple(sorted(repr(item) for item in value))
    if isinstance(value, type) or (callable(value) and not hasattr(value, "__dict__")):
        return "code", id(value)
    function = getattr(value, "__func__", value)
    if hasattr(function, "__code__"):
        return "code", id(function)
    return type(value).__qualname__, tuple(
        (name, snapshot(item, seen)) for name, item in _attributes(value)
    )


def is_alike(a: object, b: object) -> bool:
    """True if two answers agree within rounding and in type: "3.0" is not 3.0, True is not 1, and
    3.0 is not 3.

    Fields named `metrics` (durations) are not compared.
    """
    if is_dataclass(a) and type(a) is type(b):
        names = (f.name for f in fields(a) if f.name != "metrics")
        return all(is_alike(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(
            is_alike(a[key], b[key]) for key in a if key != "metrics"
        )
    if isinstance(a, (list, tuple)) and type(a) is type(b):
        return len(a) == len(b) and all(is_alike(x, y) for x, y in zip(a, b, strict=True))
    a, b = (value.item() if isinstance(value, np.generic) else value for value in (a, b))
    if isinstance(a, bool) or isinstance(b, bool):
        return a is b
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        if isinstance(a, int) is not isinstance(b, int):
            return False
        return math.isclose(a, b, rel_tol=RTOL, abs_tol=ATOL) or (a != a and b != b)
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        if a.shape != b.shape or a.dtype.kind != b.dtype.kind:
            return False
        if a.dtype.kind not in "iufc":
            return bool(np.array_equal(a, b))
        return bool(np.allclose(a, b, rtol=RTOL, atol=ATOL, equal_nan=True))
    return snapshot(a) == snapshot(b)


def has_nan(value: object) -> bool:
    """True if `value`, its fields, items or arrays contain NaN."""
    if isinstance(value, float):
        return math.isnan(value)
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "fc" and bool(np.isnan(value).any())
    if is_dataclass(value) and not isinstance(value, type):
        return any(has_nan(getattr(value, f.name)) for f in fields(value))
    if isinstance(value, Mapping):
        return any(has_nan(item) for item in value.values())
    return isinstance(value, (list, tuple)) and any(has_nan(item) for item in value)


def _array(value: object) -> object:
    try:
        array = np.ascontiguousarray(value)
    except (TypeError, RuntimeError, ValueError):  # a tensor without a numpy dtype
        return "array", repr(value)
    content = repr(array.tolist()).encode() if array.dtype == object else array.tobytes()
    return "array", array.dtype.str, array.shape, hashlib.sha256(content).hexdigest()


def _attributes(value: object) -> list[tuple[str, object]]:
    names = [
        name
        for cls in type(value).__mro__
        for name in getattr(cls, "__slots__", ())
        if not name.startswith("__")
    ]
    slots = [(name, getattr(value, name)) for name in names if hasattr(value, name)]
    return [*slots, *getattr(value, "__dict__", {}).items()]
