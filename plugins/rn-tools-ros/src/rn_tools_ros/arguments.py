"""Arguments of derived tools: their schema, and checking them without a schema library on the way of every call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from rn_tools_ros.interfaces.refusal import describe_value
from roboneuron.errors import InvalidInputError

Schema = dict[str, Any]


@dataclass(frozen=True, kw_only=True, slots=True)
class Number:
    """A number with bounds, `low` excluded when `above`."""

    text: str
    low: float
    high: float
    default: float | None = None
    above: bool = False
    integer: bool = False

    def schema(self) -> Schema:
        """Its JSON schema."""
        schema: Schema = {"type": "integer" if self.integer else "number"}
        schema["exclusiveMinimum" if self.above else "minimum"] = self.low
        schema |= {"maximum": self.high, "description": self.text}
        return schema if self.default is None else {**schema, "default": self.default}

    def take(self, name: str, arguments: Mapping[str, Any]) -> float:
        """The value, or the default."""
        value = arguments.get(name, self.default)
        if value is None:
            if self.default is None:
                raise InvalidInputError(f"Argument {name!r} is missing.", path=name)
            return self.default
        word = "an integer" if self.integer else "a number"
        if isinstance(value, bool) or not isinstance(value, int | float) or not self._holds(value):
            raise InvalidInputError(
                f"Argument {name!r} is {describe_value(value)}, expected {word} "
                f"{'above' if self.above else 'from'} {self.low:g} {'up ' if self.above else ''}to {self.high:g}.",
                path=name,
            )
        if self.integer and value != int(value):
            raise InvalidInputError(f"Argument {name!r} is {describe_value(value)}, expected an integer.", path=name)
        return int(value) if self.integer else float(value)

    def _holds(self, value: float) -> bool:
        """Whether it is within the bounds; false for NaN, which compares to nothing."""
        above = value > self.low if self.above else value >= self.low
        return above and value <= self.high


def boolean(text: str) -> Schema:
    """Schema of a flag that is false when omitted."""
    return {"type": "boolean", "description": text, "default": False}


def choice(text: str, choices: Sequence[str]) -> Schema:
    """Schema of one of several words."""
    return {"type": "string", "enum": list(choices), "description": text}


def object_schema(properties: Mapping[str, Schema], required: Sequence[str] = ()) -> Schema:
    """A strict object; `$defs` of the parts are collected at its root."""
    definitions: Schema = {}
    parts = {}
    for name, part in properties.items():
        kept = dict(part)
        definitions |= kept.pop("$defs", {})
        parts[name] = kept
    schema: Schema = {"type": "object", "properties": parts, "additionalProperties": False}
    if required:
        schema["required"] = list(required)
    if definitions:
        schema["$defs"] = definitions
    return schema


def check_names(arguments: Mapping[str, Any], known: Sequence[str]) -> None:
    """Raise InvalidInputError for an argument that the tool does not have."""
    for name in arguments:
        if name not in known:
            near = get_close_matches(str(name)[:60], known, n=1)
            hint = f"Did you mean {near[0]!r}?" if near else f"Valid: {', '.join(known) or 'none'}."
            raise InvalidInputError(f"The call has no argument {str(name)[:60]!r}.", hint=hint, path=str(name)[:60])


def take_flag(arguments: Mapping[str, Any], name: str) -> bool:
    """A boolean that is false when omitted."""
    value = arguments.get(name)
    if value is None:
        return False
    if not isinstance(value, bool):
        raise InvalidInputError(f"Argument {name!r} is {describe_value(value)}, expected true or false.", path=name)
    return value


def take_text(arguments: Mapping[str, Any], name: str, longest: int = 200) -> str:
    """A required text."""
    value = arguments.get(name)
    if not isinstance(value, str) or not 0 < len(value) <= longest:
        got = "missing" if value is None else describe_value(value)
        raise InvalidInputError(f"Argument {name!r} is {got}, expected a text of 1 to {longest} characters.", path=name)
    return value


def take_choice(arguments: Mapping[str, Any], name: str, choices: Sequence[str]) -> str:
    """A required word out of several."""
    value = arguments.get(name)
    if isinstance(value, str) and value in choices:
        return value
    listed = ", ".join(choices[:20]) + (" ..." if len(choices) > 20 else "")
    if value is None:
        raise InvalidInputError(f"Argument {name!r} is missing.", hint=f"Choose one of: {listed}.", path=name)
    near = get_close_matches(value[:60], choices, n=1) if isinstance(value, str) else []
    hint = f"Did you mean {near[0]!r}? " if near else ""
    raise InvalidInputError(
        f"Argument {name!r} is {describe_value(value)}.", hint=f"{hint}Choose one of: {listed}.", path=name
    )


def take_object(arguments: Mapping[str, Any], name: str, *, required: bool) -> Mapping[str, Any]:
    """An object; empty when omitted."""
    value = arguments.get(name)
    if value is None and not required:
        return {}
    if not isinstance(value, Mapping):
        got = "missing" if value is None else describe_value(value)
        raise InvalidInputError(f"Argument {name!r} is {got}, expected an object.", path=name)
    return value


def take_list(arguments: Mapping[str, Any], name: str, most: int) -> Sequence[Any]:
    """A required list that is not empty."""
    value = arguments.get(name)
    if not isinstance(value, list) or not 1 <= len(value) <= most:
        got = "missing" if value is None else describe_value(value)
        raise InvalidInputError(f"Argument {name!r} is {got}, expected a list of 1 to {most}.", path=name)
    return value


def inside(error: InvalidInputError, prefix: str) -> InvalidInputError:
    """The error of a value with where that value stands in the arguments."""
    path = f"{prefix}.{error.path}" if error.path else prefix
    return InvalidInputError(f"{prefix}: {error.message}", hint=error.hint, path=path)
