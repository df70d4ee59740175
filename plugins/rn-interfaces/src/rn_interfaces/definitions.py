"""Analysis of an interface definition, before anything is generated from it."""

from __future__ import annotations

from collections.abc import Mapping

from rosidl_adapter.parser import (  # type: ignore[import-untyped]
    Field,
    InvalidSpecification,
    InvalidValue,
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


def used_by(name: Name, text: str) -> frozenset[Name]:
    """Return the messages used by an interface and its parts, after checking its text.

    Raises
    ------
    ConfigurationError
        The text is no definition, or is larger than anything that a robot needs.
    """
    if len(text.encode()) > MOST_TEXT:
        raise ConfigurationError(f"{name} has more than {MOST_TEXT} bytes of text.")
    try:
        fields = _fields(name, text)
    # of the parser: besides its own errors, those that a malformed line causes in its code
    except (InvalidSpecification, InvalidValue, *_MALFORMED) as error:
        what = " ".join(str(error).split()) or type(error).__name__
        raise ConfigurationError(f"{name} is no definition: {what[:200]}.") from error
    if len(fields) > MOST_FIELDS:
        raise ConfigurationError(f"{name} has {len(fields)} fields, {MOST_FIELDS} are allowed.")
    for field in fields:
        if field.type.is_fixed_size_array() and field.type.array_size > MOST_ELEMENTS:
            raise ConfigurationError(
                f"{name}.{field.name} has {field.type.array_size} elements, {MOST_ELEMENTS} are "
                "allowed."
            )
    types = [field.type for field in fields if not field.type.is_primitive_type()]
    return _ADDED[name.kind] | {Name(one.pkg_name, "msg", one.type) for one in types}


def _fields(name: Name, text: str) -> list[Field]:
    if name.kind == "msg":
        return list(parse_message_string(name.package, name.word, text).fields)
    if name.kind == "srv":
        service = parse_service_string(name.package, name.word, text)
        return [*service.request.fields, *service.response.fields]
    action = parse_action_string(name.package, name.word, text)
    return [*action.goal.fields, *action.result.fields, *action.feedback.fields]


def by_package(used: Mapping[Name, frozenset[Name]]) -> list[list[Name]]:
    """Return the interfaces of one package after the other, those that others use first.

    Raises
    ------
    ConfigurationError
        Packages use each other in a circle, or a message holds itself.
    """
    needs: dict[str, set[str]] = {name.package: set() for name in used}
    for name, others in used.items():
        needs[name.package] |= {n.package for n in others if n.package in needs} - {name.package}
    _check_no_circle(used)
    order: list[str] = []
    while len(order) < len(needs):
        ready = [p for p in sorted(needs) if p not in order and needs[p] <= {*order}]
        if not ready:
            left = sorted(p for p in needs if p not in order)
            raise ConfigurationError(f"Packages use each other in a circle: {', '.join(left)}.")
        order += ready
    return [sorted(name for name in used if name.package == package) for package in order]


def _check_no_circle(used: Mapping[Name, frozenset[Name]]) -> None:
    done: set[Name] = set()
    while True:
        ready = {n for n in used if n not in done and used[n] & used.keys() <= done}
        if not ready:
            break
        done |= ready
    if left := sorted(map(str, used.keys() - done)):
        raise ConfigurationError(f"Messages that hold themselves cannot be sent: {left[0]}.")
