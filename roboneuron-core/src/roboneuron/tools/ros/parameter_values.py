"""Conversion of parameter values between agents and rcl_interfaces."""

from __future__ import annotations

from typing import TYPE_CHECKING

from roboneuron.errors import ConfigurationError, InvalidInputError, RefusedError
from roboneuron.tools.ros.interfaces import Plain, load_message
from roboneuron.tools.ros.interfaces.refusal import describe_value
from roboneuron.tools.ros.parameter_nodes import ParameterNode, check_parameter_name

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterValue

_FIELDS = {
    1: "bool_value",
    2: "integer_value",
    3: "double_value",
    4: "string_value",
    5: "byte_array_value",
    6: "bool_array_value",
    7: "integer_array_value",
    8: "double_array_value",
    9: "string_array_value",
}
"""Field of a ParameterValue by its type. Source: rcl_interfaces/msg/ParameterType."""
TYPE_WORDS = (
    "not set",
    "bool",
    "integer",
    "double",
    "string",
    "byte[]",
    "bool[]",
    "integer[]",
    "double[]",
    "string[]",
)
"""Words for parameter types."""


def check_exposed(node: ParameterNode, text: str) -> None:
    """Check that agents may use this parameter of the node.

    Raises:
        InvalidInputError: it is not a valid parameter name.
        RefusedError: it is not exposed.
    """
    try:
        check_parameter_name(text)
    except ConfigurationError as error:
        raise InvalidInputError(error.message, path="parameters") from error
    if text not in node.names:
        listed = ", ".join(sorted(node.names)[:20])
        raise RefusedError(
            f"{text!r} of {node.node} is not exposed.",
            hint=f"Exposed are: {listed}.",
            rule="allow_list",
        )


def check_bounds(node: ParameterNode, name: str, value: object) -> None:
    """Raise InvalidInputError for an invalid value, RefusedError for a parameter that is not
    exposed or a value out of bounds.
    """
    check_exposed(node, name)
    if not isinstance(value, bool | int | float | str | list):
        raise InvalidInputError(
            f"Parameter {name!r} is {describe_value(value)}, expected a value or a list of values."
        )
    if name not in node.bounds:
        return
    low, high = node.bounds[name]
    for item in value if isinstance(value, list) else [value]:
        if isinstance(item, bool) or not isinstance(item, int | float) or not low <= item <= high:
            raise RefusedError(
                f"{name} is {describe_value(item)}, allowed is {low:g} .. {high:g}.", rule="bounds"
            )


def to_plain(value: ParameterValue) -> Plain:
    """Value of a ParameterValue; None if the parameter is not set."""
    if value.type not in _FIELDS:
        return None
    found = getattr(value, _FIELDS[value.type])
    if value.type == 5:
        return [item[0] for item in found]
    return list(found) if value.type > 5 else found


def to_value(name: str, kind: int, given: object) -> object:
    """Create a ParameterValue of the parameter's own type. Raises InvalidInputError for a value of
    another type.
    """
    from rcl_interfaces.msg import ParameterValue  # heavy

    try:
        part = load_message("rcl_interfaces/msg/ParameterValue")
        message = part.encode({_FIELDS[kind]: given}, now_ns=None)
    except InvalidInputError as error:
        raise InvalidInputError(
            f"Parameter {name!r} is {describe_value(given)}, expected {TYPE_WORDS[kind]}.",
            path=f"parameters.{name}",
        ) from error
    assert isinstance(message, ParameterValue)
    message.type = kind
    return message
