"""Analysis of an interface definition, before anything is generated from it."""

from __future__ import annotations

import io
import keyword
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

from rosidl_adapter.parser import (  # type: ignore[import-untyped]
    Field,
    InvalidResourceName,
    InvalidSpecification,
    InvalidValue,
    MessageSpecification,
    parse_action_string,
    parse_message_string,
    parse_service_string,
)

from rn_interfaces.store import MOST_TEXT, Name
from roboneuron import ConfigurationError

MOST_ELEMENTS = 1_048_576
"""Maximum length of a fixed array: a message allocates all elements at creation."""
_EVENT = Name("service_msgs", "msg", "ServiceEventInfo")
_ADDED = {
    "msg": frozenset[Name](),
    "srv": frozenset({_EVENT}),
    "action": frozenset(
        {
            _EVENT,
            Name("builtin_interfaces", "msg", "Time"),
            Name("unique_identifier_msgs", "msg", "UUID"),
        }
    ),
}
"""Messages that rosidl adds to the parts of services and actions."""
MOST_FIELDS = 2000
_MALFORMED = (ValueError, TypeError, IndexError, KeyError, NameError, AssertionError, SyntaxError)
_LINE = re.compile(r"Error processing '(.*)' of '", re.DOTALL)
"""The line at fault, which rosidl's parser only prints."""
_OF_ROS_1 = {"time": "builtin_interfaces/Time", "duration": "builtin_interfaces/Duration"}
_TEXTS = ("string", "wstring")


class Outline(NamedTuple):
    """What a definition holds, without the content of the messages that it uses.

    Attributes:
        used: the messages that it and its parts use.
        entries: fields, and elements of fixed arrays that Python keeps in lists.
        numbers: numbers in fixed arrays.
        parts: message and count of each field that holds messages; 1 for sequences.
    """

    used: frozenset[Name]
    entries: int
    numbers: int
    parts: tuple[tuple[Name, int], ...]


def outline(name: Name, text: str) -> Outline:
    """Return what an interface holds, after checking its text.

    Raises
    ------
    ConfigurationError
        The text is no definition, cannot be used from Python, or is larger than anything that a
        robot needs; the hint says what to write instead.
    """
    if len(text.encode()) > MOST_TEXT:
        raise ConfigurationError(
            f"{name} has more than {MOST_TEXT} bytes of text.", hint="Shorten its comments."
        )
    fields = _fields(name, text)
    if len(fields) > MOST_FIELDS:
        raise ConfigurationError(
            f"{name} has {len(fields)} fields, {MOST_FIELDS} are allowed.",
            hint="Split it into messages of their own, or use arrays.",
        )
    for field in fields:
        _check(name, field)
    messages = [field for field in fields if not field.type.is_primitive_type()]
    texts = [_count(one) for one in fields if one.type.type in _TEXTS]
    numbers = [_count(one) for one in fields if one.type.is_primitive_type()]
    return Outline(
        used=_ADDED[name.kind] | {_message(one) for one in messages},
        entries=len(fields) + sum(texts),
        numbers=sum(numbers) - sum(texts),
        parts=tuple((_message(one), _count(one)) for one in messages),
    )


def _message(field: Field) -> Name:
    return Name(field.type.pkg_name, "msg", field.type.type)


def _count(field: Field) -> int:
    return int(field.type.array_size) if field.type.is_fixed_size_array() else 1


def _check(name: Name, field: Field) -> None:
    word = field.type.type
    if word in _OF_ROS_1:
        raise ConfigurationError(
            f"{name}.{field.name} has the type {word!r}, which is one of ROS 1.",
            hint=f"Write `{_OF_ROS_1[word]} {field.name}`.",
        )
    if word == "Header" and field.type.pkg_name == name.package != "std_msgs":
        raise ConfigurationError(
            f"{name}.{field.name} has the type 'Header' of its own package, as ROS 1 abbreviates "
            "it.",
            hint=f"Write `std_msgs/Header {field.name}`.",
        )
    if keyword.iskeyword(field.name):
        raise ConfigurationError(
            f"{name} has a field {field.name!r}, which is a word of Python: ROS 2 cannot generate "
            "a Python class of it.",
            hint=f"Rename it here and in the robot's package, such as `{field.name}_value`.",
        )
    if field.type.is_fixed_size_array() and field.type.array_size > MOST_ELEMENTS:
        raise ConfigurationError(
            f"{name}.{field.name} has {field.type.array_size} elements, {MOST_ELEMENTS} are "
            "allowed.",
            hint=f"Write a sequence: `{field.type.type}[] {field.name}`.",
        )


def _check_numbers(name: Name, what: str, value: object) -> None:
    """rosidl's IDL loses the sign of -inf, and takes no word in an array."""
    values = value if isinstance(value, list) else [value]
    wrong = [one for one in values if isinstance(one, float) and not math.isfinite(one)]
    if wrong and (value == -math.inf or isinstance(value, list)):
        raise ConfigurationError(
            f"{name} gives {what} the value {wrong[0]}, which ROS 2 cannot generate a class of.",
            hint="Leave the value out and set it where messages are made; `nan` and `inf` are "
            "possible for single numbers.",
        )


def _fields(name: Name, text: str) -> list[Field]:
    """All fields, after the values of all defaults and constants were checked."""
    parts = _parts(name, text)
    for part in parts:
        for constant in part.constants:
            _check_numbers(name, constant.name, constant.value)
        for field in part.fields:
            _check_numbers(name, field.name, field.default_value)
    return [field for part in parts for field in part.fields]


def _parts(name: Name, text: str) -> list[MessageSpecification]:
    printed = io.StringIO()
    try:
        with redirect_stderr(printed), redirect_stdout(printed):
            return _parse(name, text)
    # of the parser: besides its own errors, those that a malformed line causes in its code
    except (InvalidSpecification, InvalidValue, *_MALFORMED) as error:
        found = _LINE.search(printed.getvalue())
        where = f" in the line {found[1][:100]!r}" if found else ""
        what, hint = _explained(error)
        raise ConfigurationError(f"{name} is no definition: {what}{where}.", hint=hint) from error


def _explained(error: Exception) -> tuple[str, str]:
    """What is wrong, and what to write instead."""
    if isinstance(error, InvalidResourceName):
        return "the name of a type is not valid", (
            "Write a type of ROS 2, such as `float64`, or a message's CamelCase name with its "
            "package, such as `geometry_msgs/Pose`."
        )
    if isinstance(error, NameError):
        return "a name is not valid", (
            "Write fields in small letters, such as `joint_speed`, and constants in capitals, such "
            "as `int32 LIMIT=7`."
        )
    what = " ".join(str(error).split()) or type(error).__name__
    return what[:200].rstrip("."), "Write one `type name` a line, and comments after `#`."


def _parse(name: Name, text: str) -> list[MessageSpecification]:
    if name.kind == "msg":
        return [parse_message_string(name.package, name.word, text)]
    if name.kind == "srv":
        service = parse_service_string(name.package, name.word, text)
        return [service.request, service.response]
    action = parse_action_string(name.package, name.word, text)
    return [action.goal, action.result, action.feedback]


def says_the_same(name: Name, one: str, other: str) -> bool:
    """True if two texts define the same fields and constants; comments and blank lines do not
    count. False if one of them is no definition.
    """
    try:
        return _content(name, one) == _content(name, other)
    except ConfigurationError:
        return False


def _content(name: Name, text: str) -> list[str]:
    """Lines without comments and spaces, if they are a definition; raises as `outline`."""
    _parts(name, text)
    lines = (" ".join(line.partition("#")[0].split()) for line in text.splitlines())
    return [line for line in lines if line]


def by_package(used: Mapping[Name, frozenset[Name]]) -> list[list[Name]]:
    """Return the interfaces in groups of one package, those that others use first, also within
    a group. Those that hold themselves, and what uses them, are left out.
    """
    awaited = {name: len(others & used.keys()) for name, others in used.items()}
    users: dict[Name, list[Name]] = {}
    ready: dict[str, list[Name]] = {}
    for name in sorted(used):
        for other in used[name]:
            users.setdefault(other, []).append(name)
        if not awaited[name]:
            ready.setdefault(name.package, []).append(name)
    groups = []
    while ready:
        package = min(ready)
        group = ready.pop(package)
        for name in group:  # which grows meanwhile
            for user in users.get(name, ()):
                awaited[user] -= 1
                if not awaited[user]:
                    same = user.package == package
                    (group if same else ready.setdefault(user.package, [])).append(user)
        groups.append(group)
    return groups


def circles(
    used: Mapping[Name, frozenset[Name]], left: Iterable[Name]
) -> Iterator[tuple[Name, list[Name]]]:
    """Yield those of `left` that hold themselves, each with the way back to it."""
    inside = {name: sorted(used[name]) for name in left}
    for name in sorted(inside):
        if way := _way_back(name, inside):
            yield name, way


def _way_back(name: Name, used: Mapping[Name, list[Name]]) -> list[Name]:
    """The shortest way from an interface through those that it uses back to it; empty for none."""
    before: dict[Name, Name] = {}
    waiting = [name]
    for one in waiting:
        for other in used[one]:
            if other == name:
                way = [one]
                while way[-1] != name:
                    way.append(before[way[-1]])
                return way[::-1]
            if other in used and other not in before:
                before[other] = one
                waiting.append(other)
    return []
