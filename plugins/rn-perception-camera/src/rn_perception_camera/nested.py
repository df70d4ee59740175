"""Access to the image inside a message of another type, by a path of fields: `views[0].picture`."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module

from roboneuron import ConfigurationError, InvalidInputError

TYPE_PATTERN = r"^[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*$"
"""A message's full name."""
PATH_PATTERN = r"^[a-z][a-z0-9_]*(\[\d{1,4}\])?(\.[a-z][a-z0-9_]*(\[\d{1,4}\])?)*$"
"""Names of fields, with the index for an entry of an array."""
_STEP = re.compile(r"([a-z][a-z0-9_]*)(?:\[(\d+)\])?")
_ARRAY = re.compile(r"sequence<([^,>]+)(?:, \d+)?>|(.+)\[\d+\]")


def load_type(name: str) -> type:
    """Import the class of a message by its full name, such as `rig_msgs/msg/Views`.

    Raises:
        ConfigurationError: it is not installed.
    """
    package, _, word = name.partition("/msg/")
    try:
        found = getattr(import_module(f"{package}.msg"), word)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(
            f"The type {name} is unknown here.",
            hint="Install its package, or rn-interfaces, with which `roboneuron ros learn` learns "
            "types of the graph and of folders.",
        ) from error
    assert isinstance(found, type)
    return found


def image_getter(name: str, path: str, image: str) -> Callable[[object], object]:
    """Create a function that extracts the image from a message; it raises InvalidInputError for a
    missing entry.

    Args:
        name: full name of the message.
        path: path of the image.
        image: full name of the image's type.

    Raises:
        ConfigurationError: the type is unknown, or the path leads to no such image.
    """
    steps = [(step[1], step[2]) for step in _STEP.finditer(path)]
    reached = name
    for field, index in steps:
        reached = _type_of(reached, field, bool(index), f"{path!r} of {name}")
    if reached != image:
        raise ConfigurationError(
            f"The field {path!r} of {name} is a {reached}, expected {image}.",
            hint="Name the field that is the image, and its transport.",
        )
    numbered = [(field, int(index) if index else None) for field, index in steps]

    def take(message: object) -> object:
        for field, index in numbered:
            message = getattr(message, field)
            if index is not None:
                message = _entry(message, index, f"{path!r} of {name}")
        return message

    return take


def _entry(values: object, index: int, what: str) -> object:
    assert isinstance(values, list)  # as in rclpy's arrays of messages
    if index >= len(values):
        raise InvalidInputError(
            f"The field {what} has {len(values)} entries, none of them {index}."
        )
    found: object = values[index]
    return found


def _type_of(owner: str, field: str, is_entry: bool, what: str) -> str:
    """Type of a field, or of its entries."""
    if "/" not in owner:
        raise ConfigurationError(f"The field {what} goes on below a {owner}, which has no fields.")
    fields = load_type(owner).get_fields_and_field_types()  # type: ignore[attr-defined]
    if field not in fields:
        raise ConfigurationError(
            f"The field {what} does not exist: {owner} has {', '.join(sorted(fields))}."
        )
    found = str(fields[field])
    array = _ARRAY.fullmatch(found)
    if is_entry != (array is not None):
        raise ConfigurationError(
            f"The field {what}: {field} of {owner} is {'no' if is_entry else 'an'} array, so it is "
            f"written {field if is_entry else f'{field}[0]'}."
        )
    found = (array[1] or array[2]) if array is not None else found
    return found.replace("/", "/msg/")
