"""Description of an interface: a frozen tree from which schema, model, encoder and decoder are
built.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

Plain = bool | int | float | str | list["Plain"] | dict[str, "Plain"] | None
"""A JSON value."""

FLOAT32_MAX = 3.4028235e38
"""Largest number a float32 field takes: the shortest decimal that rounds to the largest finite
float32, (2 - 2**-23) * 2**127 = 3.40282346...e38 (Source: IEEE 754 binary32), so that a decoded
value can be encoded again.
"""

INTEGER_RANGES: dict[str, tuple[int, int]] = {
    **{f"int{bits}": (-(1 << bits - 1), (1 << bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, (1 << bits) - 1) for bits in (8, 16, 32, 64)},
    "octet": (0, 255),
}
"""Lowest and highest value by rosidl type; `char` is uint8, `byte` is octet."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Scalar:
    """One value.

    Attributes:
        ros: "boolean", "octet", an integer type, "float" (32 bit), "double" (64 bit), "string" or
            "wstring".
        lower, upper: allowed integers, both included; None for everything else.
        finite: NaN and infinities are refused; meaningful for floats.
        max_length: bound of a string (UTF-8 bytes; UTF-16 units for wstring), None for unbounded.
    """

    ros: str
    lower: int | None = None
    upper: int | None = None
    finite: bool = True
    max_length: int | None = None

    @property
    def is_integer(self) -> bool:
        """True for any integer type, octet and char included."""
        return self.lower is not None

    @property
    def is_float(self) -> bool:
        """True for float32 and float64."""
        return self.ros in ("float", "double")

    @property
    def is_text(self) -> bool:
        """True for string and wstring."""
        return self.ros in ("string", "wstring")


@dataclass(frozen=True, kw_only=True, slots=True)
class Nested:
    """A message inside a message."""

    message: MessageType


@dataclass(frozen=True, kw_only=True, slots=True)
class Array:
    """Several values of one type.

    Attributes:
        element: never an array itself: ROS has no arrays of arrays.
        size: exact length when `fixed`, else the longest allowed; None for unbounded.
        fixed: the length is part of the type.
    """

    element: Scalar | Nested
    size: int | None = None
    fixed: bool = False

    @property
    def is_bytes(self) -> bool:
        """True for uint8[], char[] and byte[], which are also accepted as base64."""
        return isinstance(self.element, Scalar) and self.element.ros in ("uint8", "octet")


FieldType = Scalar | Nested | Array


@dataclass(frozen=True, kw_only=True, slots=True)
class FieldChoice:
    """A named constant that belongs to a field."""

    name: str
    value: int


@dataclass(frozen=True, kw_only=True, slots=True)
class MessageField:
    """A field of a message.

    Attributes:
        name: as in the definition.
        type: its type.
        default: declared default as a plain value; None without one.
        choices: constants whose name may be given instead of the number.
        text: the authors' comment.
        unit: the authors' unit, empty without one.
    """

    name: str
    type: FieldType
    default: Plain = None
    choices: tuple[FieldChoice, ...] = ()
    text: str = ""
    unit: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class MessageType:
    """A message, or one half of a service, or one part of an action.

    Attributes:
        type_name: "geometry_msgs/msg/Twist", "std_srvs/srv/SetBool_Request".
        ros_type: the rosidl class.
        fields: in the order of the definition.
        constants: all constants by name, numbers, texts and booleans.
        text: the authors' comment.
        required: names that must be given: the only field of a wrapper such as
            std_msgs/msg/Float64, because an empty object is more likely a mistake than an intended
            zero.
    """

    type_name: str
    ros_type: type
    fields: tuple[MessageField, ...] = ()
    constants: tuple[tuple[str, bool | int | float | str], ...] = ()
    text: str = ""
    required: tuple[str, ...] = ()

    @property
    def is_time(self) -> bool:
        """True for builtin_interfaces Time and Duration, which are also accepted as a number of
        seconds.
        """
        return self.type_name in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")

    @property
    def is_header(self) -> bool:
        """True for std_msgs Header, whose omitted stamp becomes the present time."""
        return self.type_name == "std_msgs/msg/Header"

    def walk(self, path: str = "") -> Iterator[tuple[str, MessageField]]:
        """Yield every field at every depth as (dotted path without indices, field)."""
        for field in self.fields:
            here = f"{path}.{field.name}" if path else field.name
            yield here, field
            element = field.type.element if isinstance(field.type, Array) else field.type
            if isinstance(element, Nested):
                yield from element.message.walk(here)
