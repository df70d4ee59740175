"""Messages, services and actions by name: description, schema, model, encoder and decoder in one
object.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import BaseModel

from roboneuron.direct_path.interface_class import import_class
from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.tools.ros.interfaces.bounds import LOSSLESS, DecodeLimits, InputLimits
from roboneuron.tools.ros.interfaces.decode import MessageDecoder
from roboneuron.tools.ros.interfaces.derive import Deriver
from roboneuron.tools.ros.interfaces.description import (
    Array,
    MessageField,
    MessageType,
    Nested,
    Plain,
)
from roboneuron.tools.ros.interfaces.encode import MessageEncoder, encoder_for
from roboneuron.tools.ros.interfaces.model import make_model
from roboneuron.tools.ros.interfaces.naming import (
    InterfaceName,
    interface_prefixes,
    list_interfaces,
    parse_interface_name,
    unknown_interface,
)
from roboneuron.tools.ros.interfaces.picture import PICTURE_TYPES, MessagePicture, to_picture
from roboneuron.tools.ros.interfaces.refusal import Mismatch
from roboneuron.tools.ros.interfaces.scalars import Budget
from roboneuron.tools.ros.interfaces.schema import INLINE_BYTES, make_schema

_MAX_PICTURES = 4
_DEFAULT_DECODE = DecodeLimits()
_DEFAULT_INPUT = InputLimits()


class MessageInterface:
    """A message, or a service's request or response, or an action's goal, result or feedback.

    Immutable after construction and safe from any thread.

    Attributes:
        message: the description tree.
        has_header: it has a field `header`.
    """

    kind: ClassVar[str] = "msg"

    def __init__(self, message: MessageType, *, name: InterfaceName | None = None) -> None:
        self.message = message
        self._name = name
        self.has_header = hasattr(message.ros_type, "header")
        self._encoder: MessageEncoder = encoder_for(message, {})
        self._decoder = MessageDecoder(message)

    @property
    def name(self) -> str:
        """The full type name."""
        return self.message.type_name

    @property
    def fields(self) -> tuple[MessageField, ...]:
        """The message's own fields."""
        return self.message.fields

    @property
    def ros_type(self) -> object:
        """The rosidl class, as rclpy wants it."""
        return self.message.ros_type

    def json_schema(self, *, inline_bytes: int = INLINE_BYTES) -> dict[str, object]:
        """Return a new JSON schema of the values that `encode` accepts. See `interfaces.schema` for
        its limits.
        """
        return make_schema(self.message, inline_bytes=inline_bytes)

    @functools.cached_property
    def model(self) -> type[BaseModel]:
        """The pydantic model with the same rules; created on first use."""
        return make_model(self.message, _canonical)

    def encode(
        self,
        value: Mapping[str, object] | BaseModel,
        *,
        now_ns: int | None,
        limits: InputLimits = _DEFAULT_INPUT,
        argument: str = "",
    ) -> object:
        """Return a new rosidl message with exactly `value`.

        Args:
            value: plain values as in `json_schema`, or an instance of `model`.
            now_ns: ROS time for omitted header stamps [ns]; None leaves them zero.
            limits: size limits of the value.
            argument: name of the argument that holds the value, for the error.

        Raises:
            InvalidInputError: a value does not fit; names its path, the value and what is allowed.
        """
        plain = (
            value.model_dump(by_alias=True, exclude_unset=True)
            # a dict is checked first, because each check of a model costs as much as a field
            if value.__class__ is not dict and isinstance(value, BaseModel)
            else value
        )
        made = self.message.ros_type()
        try:
            self._encoder.fill(made, plain, Budget(limits, limits.items, now_ns))
        except Mismatch as mismatch:
            raise mismatch.to_error(self.message.type_name, argument) from None
        return made

    def decode(self, message: object, limits: DecodeLimits = _DEFAULT_DECODE) -> dict[str, Plain]:
        """Return a received message as JSON-serialisable values within `limits`; never refuses
        received values.

        Raises:
            InvalidInputError: `message` is of another type.
        """
        if not isinstance(message, self.message.ros_type):
            raise InvalidInputError(
                f"A {type(message).__name__} came where {self.name} is decoded."
            )
        return self._decoder.decode(message, limits)

    def pictures(
        self, message: object, limits: DecodeLimits = _DEFAULT_DECODE
    ) -> tuple[MessagePicture, ...]:
        """Return the images inside a message, at most four, in a format for clients.

        Raises:
            InvalidInputError: an image has an unknown encoding or is damaged.
        """
        found = list(_find_pictures(self.message, message, ""))[:_MAX_PICTURES]
        return tuple(
            to_picture(m, longest_side_px=limits.image_side_px, path=path) for path, m in found
        )


class ServiceInterface:
    """A service: a request and a response."""

    kind: ClassVar[str] = "srv"

    def __init__(
        self,
        name: InterfaceName,
        ros_type: object,
        request: MessageInterface,
        response: MessageInterface,
    ) -> None:
        self.name = str(name)
        self.ros_type = ros_type
        self.request = request
        self.response = response


class ActionInterface:
    """An action: a goal, its feedback, its result."""

    kind: ClassVar[str] = "action"

    def __init__(
        self,
        name: InterfaceName,
        ros_type: object,
        goal: MessageInterface,
        result: MessageInterface,
        feedback: MessageInterface,
    ) -> None:
        self.name = str(name)
        self.ros_type = ros_type
        self.goal = goal
        self.result = result
        self.feedback = feedback


Interface = MessageInterface | ServiceInterface | ActionInterface


class InterfaceLoader:
    """Loads interfaces by name and caches them. One per process is enough; usable from any
    thread.
    """

    def __init__(self) -> None:
        self._deriver = Deriver(interface_prefixes())
        self._loaded: dict[tuple[str, frozenset[str]], Interface] = {}

    def load(self, type_name: str, *, nonfinite: frozenset[str] = frozenset()) -> Interface:
        """See `load_interface`."""
        key = (type_name, nonfinite)
        if key not in self._loaded:
            self._loaded[key] = self._load(type_name, nonfinite)
        return self._loaded[key]

    def _load(self, type_name: str, nonfinite: frozenset[str]) -> Interface:
        for name in parse_interface_name(type_name):
            ros_type = import_class(name.package, name.kind, name.name)
            if ros_type is not None:
                return self._make(name, ros_type, nonfinite)
        raise unknown_interface(type_name, list_interfaces())

    def _make(self, name: InterfaceName, ros_type: Any, nonfinite: frozenset[str]) -> Interface:
        def derive(part: type) -> MessageInterface:
            message = self._deriver.derive(part, nonfinite=nonfinite)
            _check_paths(message, nonfinite)
            return MessageInterface(message, name=name)

        if name.kind == "srv":
            return ServiceInterface(
                name, ros_type, derive(ros_type.Request), derive(ros_type.Response)
            )
        if name.kind == "action":
            return ActionInterface(
                name, ros_type, *map(derive, (ros_type.Goal, ros_type.Result, ros_type.Feedback))
            )
        return derive(ros_type)


@functools.cache
def _loader() -> InterfaceLoader:
    return InterfaceLoader()


def load_interface(type_name: str, *, nonfinite: frozenset[str] = frozenset()) -> Interface:
    """Return the interface of that name, derived from the installed Python classes and cached.

    Args:
        type_name: "package/msg/Name", "package/srv/Name", "package/action/Name", or "package/Name".
        nonfinite: dotted field paths (without indices) that may hold NaN and infinities; "*" for
            all of them.

    Raises:
        UnusableTypeError: no such interface is installed; the hint names the nearest. Or its class
            is broken or too large.
        ConfigurationError: a path in `nonfinite` is not a float field.
    """
    return _loader().load(type_name, nonfinite=nonfinite)


def load_message(type_name: str, *, nonfinite: frozenset[str] = frozenset()) -> MessageInterface:
    """Like `load_interface`, for messages only. Raises ConfigurationError for a service or an
    action.
    """
    interface = load_interface(type_name, nonfinite=nonfinite)
    if isinstance(interface, MessageInterface):
        return interface
    raise ConfigurationError(
        f"{interface.name} is not a message.", hint="Topics carry package/msg/Name."
    )


def load_service(type_name: str, *, nonfinite: frozenset[str] = frozenset()) -> ServiceInterface:
    """Like `load_interface`, for services only. Raises ConfigurationError for anything else."""
    interface = load_interface(type_name, nonfinite=nonfinite)
    if isinstance(interface, ServiceInterface):
        return interface
    raise ConfigurationError(
        f"{interface.name} is not a service.", hint="Services are package/srv/Name."
    )


def load_action(type_name: str, *, nonfinite: frozenset[str] = frozenset()) -> ActionInterface:
    """Like `load_interface`, for actions only. Raises ConfigurationError for anything else."""
    interface = load_interface(type_name, nonfinite=nonfinite)
    if isinstance(interface, ActionInterface):
        return interface
    raise ConfigurationError(
        f"{interface.name} is not an action.", hint="Actions are package/action/Name."
    )


def _check_paths(message: MessageType, nonfinite: frozenset[str]) -> None:
    known = {path for path, field in message.walk() if _is_float(field)}
    for path in sorted(nonfinite - {"*"} - known):
        raise ConfigurationError(
            f"{message.type_name} has no float field {path!r}.",
            hint=f"Float fields: {', '.join(sorted(known)[:20])}.",
        )


def _is_float(field: MessageField) -> bool:
    element = field.type.element if isinstance(field.type, Array) else field.type
    return not isinstance(element, Nested) and element.is_float


def _canonical(message: MessageType, value: Mapping[str, object]) -> dict[str, Plain]:
    """Return the checked content of a model: all given fields, as plain values without
    summaries.
    """
    made = MessageInterface(message)
    return made.decode(made.encode(value, now_ns=None), LOSSLESS)


def _find_pictures(
    description: MessageType, message: object, path: str
) -> list[tuple[str, object]]:
    if description.type_name in PICTURE_TYPES:
        return [(path, message)]
    found = []
    for field in description.fields:
        here = f"{path}.{field.name}" if path else field.name
        value = getattr(message, field.name)
        if isinstance(field.type, Nested):
            found += _find_pictures(field.type.message, value, here)
        elif isinstance(field.type, Array) and isinstance(field.type.element, Nested):
            element = field.type.element.message
            for index in range(min(len(value), _MAX_PICTURES)):
                found += _find_pictures(element, value[index], f"{here}[{index}]")
    return found
