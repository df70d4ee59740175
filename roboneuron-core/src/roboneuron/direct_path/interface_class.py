"""Classes of ROS interfaces, imported and checked to be usable by name."""

from __future__ import annotations

import functools
import importlib
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from roboneuron import foreign
from roboneuron.errors import ConfigurationError

_NESTED = re.compile(r"(?:sequence<)?([a-z][\w]*)/(\w+)")
_PARTS = {"msg": (), "srv": ("Request", "Response"), "action": ("Goal", "Result", "Feedback")}


class UnusableTypeError(ConfigurationError):
    """A type is not installed, its class is broken, or it is too large to be used by agents."""


def import_class(package: str, kind: str, word: str) -> Any:
    """Return the class of an interface, None if it is not installed.

    Raises
    ------
    UnusableTypeError
        The class is broken, or too large.
    """
    name = f"{package}/{kind}/{word}"
    try:
        found = _found(package, kind, word)
        if found is not None:
            parts = [getattr(found, part) for part in _PARTS[kind]] or [found]
            for depth, fields in map(_extent, parts):
                _check_extent(name, depth, fields)
    except UnusableTypeError:
        raise
    except Exception as error:  # of generated code: whatever a name or a default causes in it
        raise UnusableTypeError(
            f"The class of {name} cannot be used: {type(error).__name__}: {str(error)[:200]}.",
            hint=f"Build the package {package} again, or learn it: `roboneuron ros learn FOLDER`, "
            "which names what is wrong.",
        ) from error
    return found


def _check_extent(name: str, depth: int, fields: int) -> None:
    if depth > foreign.MOST_TYPE_LEVELS or fields > foreign.MOST_TYPE_FIELDS:
        raise UnusableTypeError(
            f"{name} is too large: {depth} levels of messages and {min(fields, 10**9)} fields, "
            f"{foreign.MOST_TYPE_LEVELS} and {foreign.MOST_TYPE_FIELDS} are allowed.",
            hint="Split it into separate topics.",
        )


def _found(package: str, kind: str, word: str) -> Any:
    spec = find_spec(package)  # only packages of interfaces are imported
    folders = (spec.submodule_search_locations if spec is not None else None) or ()
    if not any((Path(folder) / kind / "__init__.py").is_file() for folder in folders):
        return None
    return getattr(importlib.import_module(f"{package}.{kind}"), word, None)


@functools.cache
def _extent(ros_type: Any) -> tuple[int, int]:
    """Levels and fields of a message class with all messages inside it."""
    depth, fields = 1, 0
    for text in ros_type.get_fields_and_field_types().values():
        fields += 1
        if nested := _NESTED.match(text):
            levels, inside = _extent(_found(nested[1], "msg", nested[2]))
            depth, fields = max(depth, 1 + levels), fields + inside
    return depth, fields
