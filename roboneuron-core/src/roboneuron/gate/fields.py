"""Reading and changing fields of rosidl messages by dotted path, through arrays, without knowing the type."""

from __future__ import annotations

import functools
import math
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

_FEW = 64


@dataclass(frozen=True, slots=True)
class Place:
    """A number in a message: its path with indices, its value, and how to change it."""

    path: str
    value: float
    write: Callable[[float], None]


def type_name_of(message: Any) -> str:
    """ "geometry_msgs/msg/Twist" for a Twist; parts of services and actions keep their suffix."""
    package, kind = type(message).__module__.split(".")[:2]
    return f"{package}/{kind}/{type(message).__name__}"


def is_message(value: Any) -> bool:
    """Whether this is a rosidl message."""
    return hasattr(type(value), "get_fields_and_field_types")


def read_number(message: Any, path: str) -> float:
    """The number at a dotted path without arrays on the way."""
    return float(functools.reduce(getattr, path.split("."), message))


def find_outside(message: Any, path: str, low: float, high: float) -> Iterator[Place]:
    """Yield every number outside of low .. high (NaN included) that `path`, written without indices, leads to.

    Raises:
        AttributeError: there is no such field; `check_endpoint` finds that when the configuration is read.
    """
    yield from _find(message, path, "", low, high)


def _find(message: Any, path: str, prefix: str, low: float, high: float) -> Iterator[Place]:
    head, _, rest = path.partition(".")
    value = getattr(message, head)
    here = f"{prefix}.{head}" if prefix else head
    if rest and is_message(value):
        yield from _find(value, rest, here, low, high)
    elif rest:
        for index, item in enumerate(value):
            yield from _find(item, rest, f"{here}[{index}]", low, high)
    elif isinstance(value, list | tuple | array | np.ndarray):
        numbers = np.asarray(value)
        for index in np.flatnonzero(~((numbers >= low) & (numbers <= high))).tolist():
            yield Place(f"{here}[{index}]", float(numbers[index]), _item_writer(value, index))
    elif not low <= value <= high:
        yield Place(here, float(value), lambda number: setattr(message, head, type(value)(number)))


def _item_writer(values: Any, index: int) -> Callable[[float], None]:
    def write(number: float) -> None:
        values[index] = type(values[index])(number)

    return write


def find_nonfinite(message: Any, allowed: frozenset[str], plain: str = "", path: str = "") -> str:
    """Return the path of the first NaN or infinity that is not allowed there; empty when there is none."""
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        bare = f"{plain}.{name}" if plain else name
        here = f"{path}.{name}" if path else name
        if is_message(value):
            found = find_nonfinite(value, allowed, bare, here)
        elif isinstance(value, float):
            found = "" if math.isfinite(value) or bare in allowed else here
        elif isinstance(value, array | np.ndarray):
            found = "" if bare in allowed else _first_nonfinite(value, here)
        elif isinstance(value, list) and value and is_message(value[0]):
            inner = (find_nonfinite(v, allowed, bare, f"{here}[{i}]") for i, v in enumerate(value))
            found = next((f for f in inner if f), "")
        else:
            found = ""
        if found:
            return found
    return ""


def _first_nonfinite(values: Any, path: str) -> str:
    if isinstance(values, array):
        if values.typecode not in "fd":
            return ""
        if len(values) <= _FEW:  # numpy costs more than it saves here
            return next((f"{path}[{i}]" for i, value in enumerate(values) if not math.isfinite(value)), "")
    numbers = np.asarray(values)
    if numbers.dtype.kind != "f":
        return ""
    finite = np.isfinite(numbers)
    return "" if finite.all() else f"{path}[{int(np.argmin(finite))}]"
