"""Errors for refused values: their path, the value, and what is allowed. The input is quoted with a
few words at most.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable, Mapping, Sequence

from roboneuron.errors import InvalidInputError

_SHOWN = 60


class Mismatch(Exception):
    """Raised for a value that does not fit; every level above adds its step to the path."""

    def __init__(self, got: str, allowed: str, *steps: str | int) -> None:
        super().__init__(got, allowed)
        self.got = got
        self.allowed = allowed
        self.steps: list[str | int] = list(steps)

    def to_error(self, type_name: str, argument: str = "") -> InvalidInputError:
        """The public error, with the path written as `points[3].positions[2]`; `argument` is the
        one that holds the value.
        """
        path = format_path(reversed(self.steps))
        where = f"Field '{path}' of {type_name}" if path else f"The value for {type_name}"
        text = f"{where}: got {self.got}, allowed is {self.allowed}."
        if not argument:
            return InvalidInputError(text, path=path)
        return InvalidInputError(
            f"{argument}: {text}", path=f"{argument}.{path}" if path else argument
        )


def format_path(steps: Iterable[str | int]) -> str:
    """Write steps from the outside in as a dotted path with indices."""
    path = ""
    for step in steps:
        path += f"[{step}]" if isinstance(step, int) else f".{_clip(step)}" if path else _clip(step)
    return path


def describe_value(value: object) -> str:
    """Describe a value in a few words, without inspecting containers."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return f"the boolean {json.dumps(value)}"
    if isinstance(value, str):
        return f"the text {json.dumps(_clip(value), ensure_ascii=True)}"
    if isinstance(value, int):
        if abs(value) < 10**40:
            return f"the integer {value}"
        return f"an integer of about {int(value.bit_length() * 0.30103)} digits"
    if isinstance(value, float):
        return (
            f"the number {value!r}"
            if math.isfinite(value)
            else "NaN"
            if math.isnan(value)
            else "an infinity"
        )
    if isinstance(value, Mapping):
        return f"an object with {len(value)} fields"
    if isinstance(value, Sequence):
        return f"a list of {len(value)}"
    return f"a Python {type(value).__name__}"


def unknown_field(name: object, known: Sequence[str]) -> Mismatch:
    """Create the mismatch for an unknown field."""
    shown = _clip(name) if isinstance(name, str) else describe_value(name)
    near = difflib.get_close_matches(shown, known, n=1, cutoff=0.5)
    listed = ", ".join(known[:20]) + (" ..." if len(known) > 20 else "")
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    return Mismatch(f"the unknown field '{shown}'{hint}", listed or "no field at all")


def _clip(text: str) -> str:
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
