"""Encoders of single values: from JSON to the exact type of a rosidl field."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from roboneuron.tools.ros.interfaces.bounds import InputLimits
from roboneuron.tools.ros.interfaces.description import FLOAT32_MAX, FieldChoice, Scalar
from roboneuron.tools.ros.interfaces.refusal import Mismatch, describe_value

NONFINITE_NAMES = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
"""Texts for numbers that JSON lacks; used by fields configured for them."""


@dataclass(slots=True)
class Budget:
    """Remaining input limits during one encoding, and the time for omitted stamps.

    Attributes:
        limits: per-value bounds.
        items: list elements still allowed.
        now_ns: ROS time for omitted header stamps [ns]; None leaves them zero.
    """

    limits: InputLimits
    items: int
    now_ns: int | None

    def take(self, count: int) -> None:
        """Count list elements. Raises Mismatch if there are too many."""
        self.items -= count
        if self.items < 0:
            raise Mismatch(
                f"a list of {count}",
                f"at most {self.limits.items} list elements in the whole value",
            )


Encoder = Callable[[object, Budget], object]


def make_scalar_encoder(scalar: Scalar, choices: tuple[FieldChoice, ...] = ()) -> Encoder:
    """Return a function (value, budget) -> wire value that raises Mismatch for invalid values."""
    if scalar.ros == "boolean":
        return _encode_boolean
    if scalar.is_integer:
        integer = _make_integer_encoder(scalar, choices)
        return (
            (lambda value, budget: bytes((integer(value, budget),)))
            if scalar.ros == "octet"
            else integer
        )
    if scalar.is_float:
        return _make_float_encoder(scalar)
    return _make_text_encoder(scalar)


def _encode_boolean(value: object, budget: Budget) -> bool:
    if value is True or value is False:
        return bool(value)
    raise Mismatch(describe_value(value), "true or false")


def _make_integer_encoder(
    scalar: Scalar, choices: tuple[FieldChoice, ...]
) -> Callable[[object, Budget], int]:
    lower, upper = scalar.lower or 0, scalar.upper or 0
    names = {choice.name: choice.value for choice in choices}
    allowed = f"an integer {lower}..{upper}"
    if names:
        listed = [f"{name}={number}" for name, number in list(names.items())[:20]]
        allowed += f" or one of {', '.join(listed)}{' ...' if len(names) > 20 else ''}"

    def encode(value: object, budget: Budget) -> int:
        if value.__class__ is not int:
            value = _to_integer(value)
        if lower <= value <= upper:
            number: int = value
            return number
        raise Mismatch(describe_value(value), allowed)

    def _to_integer(value: object) -> int:
        if isinstance(value, str):
            if value in names:
                return names[value]
        elif isinstance(value, float):
            if value.is_integer():
                return int(value)
        elif isinstance(value, int) and not isinstance(value, bool):
            return int(value)
        raise Mismatch(describe_value(value), allowed)

    return encode


def _make_float_encoder(scalar: Scalar) -> Callable[[object, Budget], float]:
    limit = FLOAT32_MAX if scalar.ros == "float" else math.inf
    allowed = "a finite number" + (
        f" of at most {FLOAT32_MAX} (float32)" if scalar.ros == "float" else ""
    )
    if not scalar.finite:
        allowed += ' or one of the texts "NaN", "Infinity", "-Infinity"'
    finite = scalar.finite

    def encode(value: object, budget: Budget) -> float:
        if value.__class__ is not float:
            value = _to_float(value)
        if -limit <= value <= limit and value - value == 0.0:
            number: float = value
            return number
        if not finite and value - value != 0.0:
            return float(value)
        raise Mismatch(describe_value(value), allowed)

    def _to_float(value: object) -> float:
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                return float(value)
            except OverflowError:
                raise Mismatch(describe_value(value), allowed) from None
        if not finite and isinstance(value, str) and value in NONFINITE_NAMES:
            return NONFINITE_NAMES[value]
        raise Mismatch(describe_value(value), allowed)

    return encode


def _make_text_encoder(scalar: Scalar) -> Callable[[object, Budget], str]:
    wide, bound = scalar.ros == "wstring", scalar.max_length
    allowed = (
        "a text"
        if bound is None
        else f"a text of at most {bound} {'UTF-16 units' if wide else 'bytes'}"
    )

    def encode(value: object, budget: Budget) -> str:
        if not isinstance(value, str):
            raise Mismatch(describe_value(value), allowed)
        longest = budget.limits.text_bytes
        if len(value) > longest:
            raise Mismatch(
                f"a text of {len(value)} characters", f"a text of at most {longest} bytes"
            )
        try:
            size = len(value.encode("utf-16-le")) // 2 if wide else len(value.encode("utf-8"))
        except UnicodeEncodeError:
            raise Mismatch("a text with half of a surrogate pair", "valid Unicode") from None
        if not wide and "\0" in value:
            raise Mismatch(
                "a text with a NUL character", "a text without it: ROS strings end there"
            ) from None
        if size > longest:
            raise Mismatch(f"a text of {size} bytes", f"a text of at most {longest} bytes")
        if bound is not None and size > bound:
            raise Mismatch(f"a text of {size}", allowed)
        return str(value)

    return encode
