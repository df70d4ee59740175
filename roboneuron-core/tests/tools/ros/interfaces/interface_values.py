"""Random valid values for any interface, and an independent check that a decoded message holds
them.

Not a test file: loaded by conftest.py and by the child processes of the two-process tests.
"""

from __future__ import annotations

import base64
import random
from collections.abc import Mapping
from typing import Any

import numpy as np

from roboneuron.tools.ros.interfaces import (
    ActionInterface,
    Array,
    InterfaceName,
    MessageField,
    MessageInterface,
    MessageType,
    Nested,
    Scalar,
    ServiceInterface,
    load_interface,
)

LETTERS = "abc XYZ_/09.\"'\\\n\t<>{}éßハロ😀"
FLOATS = (0.0, -0.0, 1.0, -1.5, 0.1, 1e-30, 123456.789, -3.4e38, 5e-324, 1.7976931348623157e308)
FLOAT32_MAX = 3.4028235e38


def parts_of(name: InterfaceName | str) -> tuple[MessageInterface, ...]:
    """The message, or request and response, or goal, result and feedback."""
    interface = load_interface(str(name))
    if isinstance(interface, ServiceInterface):
        return interface.request, interface.response
    if isinstance(interface, ActionInterface):
        return interface.goal, interface.result, interface.feedback
    return (interface,)


class ValueGenerator:
    """Draws valid values from a seed; `portable` leaves out what a JSON schema cannot express."""

    def __init__(self, seed: int, *, portable: bool = False) -> None:
        self._random = random.Random(seed)
        self._portable = portable

    def value(self, message: MessageType) -> dict[str, Any]:
        chosen = [
            f for f in message.fields if f.name in message.required or self._random.random() < 0.85
        ]
        return {f.name: self._field(f) for f in chosen}

    def _field(self, field: MessageField) -> Any:
        if field.choices and self._random.random() < 0.4:
            return self._random.choice(field.choices).name
        if isinstance(field.type, Array):
            return self._array(field.type)
        return self._one(field.type)

    def _one(self, kind: Scalar | Nested) -> Any:
        if isinstance(kind, Scalar):
            return self._scalar(kind)
        if kind.message.is_time and self._random.random() < 0.4:
            return self._random.choice([0, 1.5, -2.25, 1_700_000_000.125, 7])
        return self.value(kind.message)

    def _array(self, shape: Array) -> Any:
        longest = 3 if isinstance(shape.element, Nested) else 9
        size = (
            shape.size
            if shape.fixed
            else self._random.randint(0, min(longest, shape.size or longest))
        )
        if shape.is_bytes and self._random.random() < 0.3:
            return base64.b64encode(self._random.randbytes(size or 0)).decode()
        return [self._one(shape.element) for _ in range(size or 0)]

    def _scalar(self, kind: Scalar) -> Any:
        rng = self._random
        if kind.ros == "boolean":
            return rng.random() < 0.5
        if kind.is_integer:
            low, high = kind.lower or 0, kind.upper or 0
            number = rng.choice([low, high, 0, 1, rng.randint(low, high)])
            return float(number) if abs(number) < 1000 and rng.random() < 0.1 else number
        if kind.is_float:
            number = rng.choice([*FLOATS, rng.uniform(-1e3, 1e3), rng.randint(-9, 9)])
            return number if kind.ros == "double" or abs(number) <= FLOAT32_MAX else FLOAT32_MAX
        limit = min(12, kind.max_length if kind.max_length is not None else 12)
        letters = LETTERS[:20] if self._portable or kind.max_length is not None else LETTERS
        return "".join(rng.choice(letters) for _ in range(rng.randint(0, limit)))


def differences(
    message: MessageType, given: Mapping[str, Any], decoded: Mapping[str, Any], path: str = ""
) -> list[str]:
    """Where the decoded message does not hold the given value; written without the encoder's
    code.
    """
    found: list[str] = []
    for field in message.fields:
        here = f"{path}.{field.name}" if path else field.name
        if field.name in given:
            found += _compare(field, field.type, given[field.name], decoded[field.name], here)
        elif field.default is not None and not isinstance(field.type, Nested):
            found += _compare(field, field.type, field.default, decoded[field.name], here)
    return found


def _compare(field: MessageField, kind: Any, given: Any, decoded: Any, path: str) -> list[str]:
    if isinstance(kind, Array):
        left, right = _as_list(kind, given), _as_list(kind, decoded)
        if len(left) != len(right):
            return [f"{path}: {len(left)} != {len(right)} elements"]
        return [
            d
            for i, (a, b) in enumerate(zip(left, right, strict=True))
            for d in _compare(field, kind.element, a, b, f"{path}[{i}]")
        ]
    if isinstance(kind, Nested):
        if kind.message.is_time and not isinstance(given, Mapping):
            return (
                []
                if decoded["sec"] + decoded["nanosec"] * 1e-9 == given
                else [f"{path}: {given} != {decoded}"]
            )
        return differences(kind.message, given, decoded, path)
    expected = next((c.value for c in field.choices if c.name == given), given)
    if kind.ros == "float":
        same = np.float32(expected).tobytes() == np.float32(decoded).tobytes()
    elif kind.ros == "double":
        same = np.float64(expected).tobytes() == np.float64(decoded).tobytes()
    else:
        same = type(decoded) in (bool, int, str) and expected == decoded
    return [] if same else [f"{path}: {expected!r} != {decoded!r}"]


def _as_list(kind: Array, value: Any) -> list[Any]:
    return (
        list(base64.b64decode(value)) if kind.is_bytes and isinstance(value, str) else list(value)
    )
