"""Fields of rosidl messages: read, changed and filled by dotted path through arrays, without the
type at import time.
"""

from __future__ import annotations

import functools
import math
import re
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, TypeGuard, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from roboneuron.direct_path.interface_class import UnusableTypeError, import_class
from roboneuron.direct_path.message_types import MessageName, RosMessage
from roboneuron.errors import ConfigurationError, InvalidInputError

__all__ = ["check_path", "load_type", "read_value"]
"""Names that other distributions may use."""

FLOATS = frozenset({"float", "double"})
INTEGERS = frozenset(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
"""Integer types in rosidl notation; `octet` and `boolean` are not numbers."""
_TYPE_NAME = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv|action)/([A-Z][A-Za-z0-9]*)")
_ELEMENT = re.compile(r"(?:sequence<)?([\w/]+)")
_STEP = re.compile(r"(\w+)((?:\[\d{1,9}\])?)")
"""One step of a read path: a field, or one element of it."""
_FEW = 64
M = TypeVar("M")
R = TypeVar("R", bound=RosMessage)


@dataclass(frozen=True, slots=True)
class MessageNumber:
    """A number in a message: its path with indices, its value, and a setter."""

    path: str
    value: float
    write: Callable[[float], None]


def type_name_of(message: object) -> str:
    """ "geometry_msgs/msg/Twist" for a Twist; parts of services and actions keep their suffix."""
    ros_type: type = type(message)
    return _name_of_class(ros_type)


def is_message(value: object) -> TypeGuard[RosMessage]:
    """True for a rosidl message."""
    return hasattr(type(value), "get_fields_and_field_types")


@functools.cache
def load_type(name: str) -> Any:
    """Import the rosidl class "package/msg/Name", "package/srv/Name" or "package/action/Name".

    Raises:
        ConfigurationError: the name has another format.
        UnusableTypeError: it is not installed, or as `import_class`.
    """
    parts = _TYPE_NAME.fullmatch(name)
    if parts is None:
        raise ConfigurationError(
            f"{name[:120]!r}: write the type in full, package/msg/Name, srv or action."
        )
    package, kind, word = parts.groups()
    found = import_class(package, kind, word)
    if found is None:
        raise UnusableTypeError(
            f"No installed interface is called {name!r}.", hint=f"Install the package {package}."
        )
    return found


def nested(
    message: RosMessage, types: Collection[MessageName[M]], path: str = ""
) -> Iterator[tuple[str, M]]:
    """Yield the messages of some types in a message: itself, or nested at any depth, with the path
    prefix of their fields: "", "pose.", "poses[2].". The search does not continue inside of them.
    """
    if type_name_of(message) in types:
        yield path, cast("M", message)  # its name determines its type
        return
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        if is_message(value):
            yield from nested(value, types, f"{path}{name}.")
        elif isinstance(value, list | tuple):
            for index, item in enumerate(value):
                if is_message(item):
                    yield from nested(item, types, f"{path}{name}[{index}].")


def walk_fields(ros_type: type[RosMessage], path: str = "") -> Iterator[tuple[str, str]]:
    """Yield each field of a message class at every depth: dotted path without indices, type of it
    or its elements.
    """
    for name, text in ros_type.get_fields_and_field_types().items():
        here = f"{path}.{name}" if path else name
        element = _element_of(text)
        yield here, element
        if "/" in element:
            yield from walk_fields(_nested(element), here)


@functools.cache
def has_arrays(ros_type: type[RosMessage]) -> bool:
    """True if messages of a class contain an array, at any depth."""
    return any(
        _is_array(text) or ("/" in text and has_arrays(_nested(text)))
        for text in ros_type.get_fields_and_field_types().values()
    )


def check_path(ros_type: type[RosMessage], path: str) -> None:
    """Check a path that reads one value, such as "pose.position.z" or "effort[7]", by the fields of
    a message class.

    Raises:
        InvalidInputError: a field does not exist in the interface, or the path leads to no single
            value.
    """
    name, here = _name_of_class(ros_type), ros_type
    steps = path.split(".")
    for number, step in enumerate(steps):
        parts = _STEP.fullmatch(step)
        types = here.get_fields_and_field_types()
        if parts is None or parts[1] not in types:
            raise InvalidInputError(
                f"{name} has no field {path[:80]!r}.",
                hint=f"{_name_of_class(here)} has: {', '.join(types) or 'no fields'}.",
            )
        text = types[parts[1]]
        element = _element_of(text)
        is_array = _is_array(text)
        if is_array is not bool(parts[2]):
            what = "an array: name one element, such as [0]" if is_array else "no array"
            raise InvalidInputError(f"{parts[1]} of {_name_of_class(here)} is {what}.")
        is_last = number == len(steps) - 1
        if is_last is ("/" in element):
            what = (
                f"a message of {element}: name one of its fields"
                if is_last
                else f"a {element}: it has no fields"
            )
            raise InvalidInputError(f"{parts[1]} of {_name_of_class(here)} is {what}.")
        if not is_last:
            here = _nested(element)


def read_value(message: object, path: str) -> bool | int | float | str | bytes:
    """Return the value at a path that passed `check_path` for the message's class; only fields are
    read.

    Raises:
        LookupError: there is no such field, or an array is shorter.
    """
    value = message
    for step in path.split("."):
        parts = _STEP.fullmatch(step)
        if (
            parts is None
            or not is_message(value)
            or parts[1] not in value.get_fields_and_field_types()
        ):
            raise LookupError(f"{type(message).__name__} has no field {path[:80]!r}")
        value = getattr(value, parts[1])
        if parts[2]:
            index = int(parts[2][1:-1])
            if not isinstance(value, list | tuple | array | np.ndarray) or index >= len(value):
                raise LookupError(f"{type(message).__name__} has no {path[:80]!r} now")
            value = value[index]
    found = value.item() if isinstance(value, np.generic) else value
    if not isinstance(found, bool | int | float | str | bytes):
        raise LookupError(f"{path[:80]!r} of {type(message).__name__} is no single value")
    return found


@functools.cache
def _name_of_class(ros_type: type) -> str:
    package, kind = ros_type.__module__.split(".")[:2]
    return f"{package}/{kind}/{ros_type.__name__}"


def _element_of(text: str) -> str:
    """ "double" of "double", "sequence<double, 3>" and "double[9]"."""
    found = _ELEMENT.match(text)
    assert found is not None
    return found[1]


def _is_array(text: str) -> bool:
    return text != _element_of(text) and not text.startswith(("string<", "wstring<"))


def _nested(element: str) -> type[RosMessage]:
    ros_type: type[RosMessage] = load_type(element.replace("/", "/msg/"))
    return ros_type


def filled(ros_type: type[R], values: object) -> R:
    """Create a message from the values of a JSON object; missing fields are zero.

    Raises:
        InvalidInputError: there is no such field, or it cannot contain the value.
    """
    message = ros_type(check_fields=True)
    types = message.get_fields_and_field_types()
    if not isinstance(values, Mapping) or not values.keys() <= types.keys():
        raise InvalidInputError(
            f"{type_name_of(message)} takes an object with fields out of: {', '.join(types)}."
        )
    for name, value in values.items():
        element = _element_of(types[name])
        try:
            made = (
                [_converted(element, item) for item in value]
                if _is_array(types[name])
                else _converted(element, value)
            )
            setattr(message, name, made)
        except (AssertionError, TypeError, ValueError, OverflowError) as error:
            raise InvalidInputError(
                f"{name} of {type_name_of(message)} cannot be {str(value)[:60]}."
            ) from error
    return message


def _converted(element: str, value: Any) -> object:
    if "/" in element:
        return filled(_nested(element), value)
    if element in FLOATS and not isinstance(value, bool):
        return float(value)
    return bytes([value]) if element == "octet" else value


def read_number(message: RosMessage, path: str) -> float:
    """Read the number at a dotted path without arrays."""
    return float(attrgetter(path)(message))


def find_outside(
    message: object, path: str, low: float, high: float, prefix: str = ""
) -> Iterator[MessageNumber]:
    """Yield every number at `path`, written without indices, that is outside of low .. high or NaN.

    `prefix` is the path of `message` itself.

    Raises:
        AttributeError: there is no such field; `check_endpoint` detects that when the configuration
            is read.
    """
    head, _, rest = path.partition(".")
    value = getattr(message, head)
    here = f"{prefix}.{head}" if prefix else head
    if rest and is_message(value):
        yield from find_outside(value, rest, low, high, here)
    elif rest:
        for index, item in enumerate(value):
            yield from find_outside(item, rest, low, high, f"{here}[{index}]")
    elif isinstance(value, list | tuple | array | np.ndarray):
        numbers = np.asarray(value)
        for index in np.flatnonzero(~((numbers >= low) & (numbers <= high))).tolist():
            yield MessageNumber(
                f"{here}[{index}]", float(numbers[index]), _item_writer(value, index)
            )
    elif not low <= value <= high:
        yield MessageNumber(
            here, float(value), lambda number: setattr(message, head, type(value)(number))
        )


def _item_writer(values: Any, index: int) -> Callable[[float], None]:
    def write(number: float) -> None:
        values[index] = type(values[index])(number)

    return write


def find_nonfinite(message: RosMessage, allowed: frozenset[str]) -> str:
    """Return the path of the first NaN or infinity that is not allowed there; empty if there is
    none.
    """
    return next((path for plain, path in _nonfinite(message) if plain not in allowed), "")


def _nonfinite(message: RosMessage) -> Iterator[tuple[str, str]]:
    """Yield the path without indices, and the whole path, of each NaN or infinity; for an array of
    numbers only the first. Paths are built only for these, because every call is checked.
    """
    for name in _names_of_fields(type(message)):
        value = getattr(message, name)
        if isinstance(value, float):
            if not math.isfinite(value):
                yield name, name
        elif is_message(value):
            for plain, path in _nonfinite(value):
                yield f"{name}.{plain}", f"{name}.{path}"
        elif isinstance(value, array | np.ndarray):
            found = _first_nonfinite(value, name)
            if found:
                yield name, found
        elif isinstance(value, list) and value and is_message(value[0]):
            for index, item in enumerate(value):
                for plain, path in _nonfinite(item):
                    yield f"{name}.{plain}", f"{name}[{index}].{path}"


@functools.cache
def _names_of_fields(ros_type: type[RosMessage]) -> tuple[str, ...]:
    """Cached, because rosidl copies its own table for each access."""
    return tuple(ros_type.get_fields_and_field_types())


def _first_nonfinite(values: array[float] | NDArray[np.generic], path: str) -> str:
    if isinstance(values, array):
        if values.typecode not in "fd":
            return ""
        if len(values) <= _FEW:  # numpy costs more than it saves here
            return next(
                (f"{path}[{i}]" for i, value in enumerate(values) if not math.isfinite(value)), ""
            )
    numbers = np.asarray(values)
    if numbers.dtype.kind != "f":
        return ""
    finite = np.isfinite(numbers)
    return "" if finite.all() else f"{path}[{int(np.argmin(finite))}]"
