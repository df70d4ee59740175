"""Types, finiteness and per-field limits; how a configuration tightens what a robot's profile allows."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from roboneuron.contract import TWIST_FIELDS, Endpoint, check_twist
from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.gate.fields import find_nonfinite, find_outside, read_number, type_name_of
from roboneuron.gate.request import ROLE_BY_KIND, AllowedEndpoint, Clamp
from roboneuron.interfaces import (
    ActionInterface,
    Array,
    FieldType,
    Message,
    Nested,
    Scalar,
    ServiceInterface,
    load_interface,
)

_TOPIC = re.compile(r"/?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*\Z")
_NAME = re.compile(r"[a-z][a-z0-9_]{0,59}\Z")
_TWISTS = {"geometry_msgs/msg/Twist": "", "geometry_msgs/msg/TwistStamped": "twist."}
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration", "std_msgs/msg/Header")
_SUFFIX = {"service": "_Request", "action": "_Goal"}


@dataclass(frozen=True, kw_only=True, slots=True)
class ConfiguredLimits:
    """What the configuration says about an endpoint, on top of the robot's profile.

    Attributes:
        bounds: field path -> (lowest, highest), within the profile's.
        rate_hz: most messages per second, not above the profile's; None keeps it.
        clamp: field paths to clamp instead of refuse; each needs a bound.
    """

    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rate_hz: float | None = None
    clamp: frozenset[str] = frozenset()


def tighten(endpoint: Endpoint, limits: ConfiguredLimits) -> Endpoint:
    """Return the endpoint with the configured limits.

    Raises:
        ConfigurationError: a limit is wider than the profile's, or a path to clamp has no bound.
    """
    bounds = dict(endpoint.bounds)
    for path, (low, high) in limits.bounds.items():
        lowest, highest = endpoint.bounds.get(path, (-math.inf, math.inf))
        if not lowest <= low <= high <= highest:
            raise ConfigurationError(
                f"Endpoint {endpoint.name!r}: {path} = [{low:g}, {high:g}] is not a range within the robot's "
                f"[{lowest:g}, {highest:g}]; limits can only be tightened."
            )
        bounds[path] = (low, high)
    for path in sorted(limits.clamp - set(bounds)):
        raise ConfigurationError(f"Endpoint {endpoint.name!r}: {path} is to be clamped, but nothing bounds it.")
    rate_hz = endpoint.rate_hz if limits.rate_hz is None else limits.rate_hz
    if endpoint.rate_hz and not 0.0 < rate_hz <= endpoint.rate_hz:
        raise ConfigurationError(
            f"Endpoint {endpoint.name!r}: rate_hz = {rate_hz:g} is above the robot's {endpoint.rate_hz:g}."
        )
    return replace(endpoint, bounds=bounds, rate_hz=rate_hz)


def check_endpoint(endpoint: Endpoint) -> None:
    """Raise unless an endpoint of a profile or a configuration can be exposed.

    Raises:
        ConfigurationError: its name, kind, topic, type or a bounded field cannot be.
    """
    where = f"Endpoint {endpoint.name!r}"
    if not _NAME.match(endpoint.name):
        raise ConfigurationError(f"{where}: the name must be lower-case letters, digits and underscores.")
    if endpoint.kind not in ROLE_BY_KIND:
        raise ConfigurationError(f"{where}: kind {endpoint.kind!r} is none of {', '.join(ROLE_BY_KIND)}.")
    if len(endpoint.topic) > 200 or not _TOPIC.match(endpoint.topic):
        raise ConfigurationError(f"{where}: {endpoint.topic[:80]!r} is not a topic name.")
    if not (math.isfinite(endpoint.rate_hz) and endpoint.rate_hz >= 0.0):
        raise ConfigurationError(f"{where}: rate_hz = {endpoint.rate_hz} must be 0 or more.")
    message = _sent_message(endpoint)
    if endpoint.type != load_interface(endpoint.type).name:
        raise ConfigurationError(f"{where}: write the type in full, {load_interface(endpoint.type).name}.")
    numbers = {path: field.type for path, field in message.walk() if _is_number(field.type)}
    for path, (low, high) in endpoint.bounds.items():
        if path not in numbers:
            raise ConfigurationError(
                f"{where}: {message.type_name} has no number {path!r}.",
                hint=f"Numbers: {', '.join(sorted(numbers)[:20])}.",
            )
        if not low <= high or (_is_integer(numbers[path]) and not _are_integers(low, high)):
            raise ConfigurationError(f"{where}: the bounds of {path} are [{low}, {high}].")


def number_fields(endpoint: Endpoint) -> list[str]:
    """Paths of all numbers that may be sent to an endpoint, but for times and headers, which move nothing."""
    numbers: list[str] = []
    times: list[str] = []
    for path, part in _sent_message(endpoint).walk():
        element = part.type.element if isinstance(part.type, Array) else part.type
        if isinstance(element, Nested) and element.message.type_name in _TIMES:
            times.append(f"{path}.")
        elif _is_number(part.type) and not path.startswith(tuple(times)):
            numbers.append(path)
    return numbers


def sent_types(kind: str, type_name: str) -> set[str]:
    """Types of the messages within what an endpoint of this kind and type is sent."""
    message = _sent_message(Endpoint(name="", kind=kind, topic="", type=type_name, summary=""))
    elements = (part.type.element if isinstance(part.type, Array) else part.type for _, part in message.walk())
    return {element.message.type_name for element in elements if isinstance(element, Nested)}


def _sent_message(endpoint: Endpoint) -> Message:
    interface = load_interface(endpoint.type)
    kinds = {"service": ServiceInterface, "action": ActionInterface}
    expected = kinds.get(endpoint.kind)
    if isinstance(interface, ServiceInterface | ActionInterface):
        if expected is None or not isinstance(interface, expected):
            raise ConfigurationError(f"Endpoint {endpoint.name!r}: a {endpoint.kind} cannot be of {interface.name}.")
        part = interface.request if isinstance(interface, ServiceInterface) else interface.goal
        return part.message
    if expected is not None:
        raise ConfigurationError(f"Endpoint {endpoint.name!r}: a {endpoint.kind} cannot be of {interface.name}.")
    return interface.message


def _is_number(field_type: FieldType) -> bool:
    element = field_type.element if isinstance(field_type, Array) else field_type
    if not isinstance(element, Scalar) or element.ros == "octet":
        return False
    return element.is_float or element.is_integer


def _is_integer(field_type: FieldType) -> bool:
    element = field_type.element if isinstance(field_type, Array) else field_type
    return isinstance(element, Scalar) and element.is_integer


def _are_integers(low: float, high: float) -> bool:
    """Bounds of an integer field are integers, so that a clamped value lies within."""
    return all(math.isinf(bound) or bound == int(bound) for bound in (low, high))


def check_type(endpoint: Endpoint, message: Any) -> None:
    """Raise RefusedError unless the message is of the endpoint's type."""
    came, expected = type_name_of(message), endpoint.type + _SUFFIX.get(endpoint.kind, "")
    if came != expected:
        raise RefusedError(f"A {came} came for endpoint {endpoint.name!r}, which takes {expected}.")


def check_finite(allowed: AllowedEndpoint, message: Any) -> None:
    """Raise RefusedError for a NaN or an infinity anywhere but in the fields configured for them."""
    path = find_nonfinite(message, allowed.nonfinite)
    if path:
        raise RefusedError(f"{path} is not finite; nothing was sent to {allowed.endpoint.name!r}.")


def apply_bounds(allowed: AllowedEndpoint, message: Any) -> tuple[Clamp, ...]:
    """Raise RefusedError for a value out of bounds; clamp, in the message, where that is configured."""
    clamps = []
    for path, (low, high) in allowed.endpoint.bounds.items():
        for place in find_outside(message, path, low, high):
            if path not in allowed.clamp or math.isnan(place.value):
                raise RefusedError(f"{place.path} is {place.value:g}, allowed is {low:g} .. {high:g}.")
            sent = low if place.value < low else high
            place.write(sent)
            clamps.append(Clamp(path=place.path, asked=place.value, sent=sent))
    return tuple(clamps)


def check_steering(endpoint: Endpoint, message: Any) -> None:
    """Raise RefusedError for a velocity that the base cannot carry out. Source: `contract.check_twist`."""
    prefix = _TWISTS.get(endpoint.type)
    if prefix is None or endpoint.min_turning_radius_m <= 0.0:
        return
    values = {path: read_number(message, prefix + path) for path in TWIST_FIELDS}
    check_twist(replace(endpoint, bounds={}), values)
