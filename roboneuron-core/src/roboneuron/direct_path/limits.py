"""Checks of types, finiteness and per-field limits."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from operator import attrgetter

from roboneuron.contract import Endpoint
from roboneuron.direct_path.fields import (
    FLOATS,
    INTEGERS,
    find_nonfinite,
    find_outside,
    has_arrays,
    load_type,
    read_number,
    type_name_of,
    walk_fields,
)
from roboneuron.direct_path.message_types import RosMessage
from roboneuron.direct_path.places import PLACE_TYPES
from roboneuron.direct_path.plans import has_plans
from roboneuron.direct_path.request import ROLE_BY_KIND, AllowedEndpoint
from roboneuron.direct_path.twists import TWIST_FIELDS, check_twist
from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.server.verdict import Clamp

_TOPIC_RULE = (
    'A name is words of letters, digits and underscores with "/" between them, such as '
    "/arm/joint_states; each word begins with a letter, and it has at most 200 characters."
)
_TOPIC = re.compile(r"/?[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*\Z")
_NAME = re.compile(r"[a-z][a-z0-9_]{0,59}\Z")
_TWISTS = {"geometry_msgs/msg/Twist": "", "geometry_msgs/msg/TwistStamped": "twist."}
_PART = {"srv": "Request", "action": "Goal"}
"""Sent part of a type that is not a message."""
PARAMETER_QUERIES = frozenset(
    f"rcl_interfaces/srv/{verb}Parameters" for verb in ("Get", "List", "Describe")
)
"""Services that change nothing and may be endpoints of kind "read"."""


def check_endpoint(endpoint: Endpoint) -> None:
    """Check that an endpoint of a profile or a configuration can be exposed.

    Raises:
        ConfigurationError: its name, kind, topic, type or a bounded field is invalid.
    """
    where = f"Endpoint {endpoint.name!r}"
    if not _NAME.match(endpoint.name):
        raise ConfigurationError(
            f"{where}: the name must be lower-case letters, digits and underscores."
        )
    if endpoint.kind not in ROLE_BY_KIND:
        raise ConfigurationError(
            f"{where}: kind {endpoint.kind!r} is none of {', '.join(ROLE_BY_KIND)}."
        )
    if len(endpoint.topic) > 200 or not _TOPIC.match(endpoint.topic):
        raise ConfigurationError(
            f"{where}: {endpoint.topic[:80]!a} is not a topic name.", hint=_TOPIC_RULE
        )
    if not (math.isfinite(endpoint.rate_hz) and endpoint.rate_hz >= 0.0):
        raise ConfigurationError(f"{where}: rate_hz = {endpoint.rate_hz} must be 0 or more.")
    ros_type = sent_type(endpoint)
    _check_frame(endpoint, ros_type)
    numbers = {path: name for path, name in walk_fields(ros_type) if name in FLOATS | INTEGERS}
    for path, (low, high) in endpoint.bounds.items():
        if path not in numbers:
            raise ConfigurationError(
                f"{where}: {endpoint.type} has no number {path!r}.",
                hint=f"Numbers: {', '.join(sorted(numbers)[:20])}.",
            )
        if not low <= high or (numbers[path] in INTEGERS and not _are_integers(low, high)):
            raise ConfigurationError(f"{where}: the bounds of {path} are [{low}, {high}].")


def _check_frame(endpoint: Endpoint, ros_type: type[RosMessage]) -> None:
    """Raise ConfigurationError unless limits of place apply to the sent type."""
    where = f"Endpoint {endpoint.name!r}"
    if endpoint.zones and not endpoint.frame:
        raise ConfigurationError(
            f"{where} has zones and no frame.", hint='Say which frame they are in: frame = "map".'
        )
    types = {name for _, name in walk_fields(ros_type)}
    nested = {name.replace("/msg", "") for name in PLACE_TYPES}
    is_place = endpoint.type in PLACE_TYPES or not nested.isdisjoint(types)
    if endpoint.frame and not is_place:
        raise ConfigurationError(
            f"{where}: {endpoint.type} sends no place, so it has no frame.",
            hint=f"Types of places: {', '.join(PLACE_TYPES)}.",
        )
    for zone in endpoint.zones:
        if not (zone.lower_m <= zone.upper_m).all():
            raise ConfigurationError(f"{where}: the corners of the zone {zone.name!r} are swapped.")


def sent_type(endpoint: Endpoint) -> type[RosMessage]:
    """Return the rosidl class that is sent to an endpoint: its message, request or goal. Raises
    ConfigurationError.
    """
    ros_type = load_type(endpoint.type)
    kind = endpoint.type.split("/")[1]
    is_query = endpoint.kind == "read" and endpoint.type in PARAMETER_QUERIES
    if kind != {"service": "srv", "action": "action"}.get(endpoint.kind, "msg") and not is_query:
        raise ConfigurationError(
            f"Endpoint {endpoint.name!r}: a {endpoint.kind} cannot be of {endpoint.type}."
        )
    sent: type[RosMessage] = getattr(ros_type, _PART[kind]) if kind in _PART else ros_type
    return sent


def _are_integers(low: float, high: float) -> bool:
    """True if the bounds of an integer field are integers, so that a clamped value lies within."""
    return all(math.isinf(bound) or bound == int(bound) for bound in (low, high))


class MessageChecks:
    """Prepared checks of messages for one endpoint; created when it is exposed, because inspecting
    a type delays the agent's call.

    The numbers of a message without arrays are read in one step; only after a violation they are
    checked field by field.

    Args:
        allowed: an entry that passed `check_endpoint`.

    Attributes:
        has_plans: sent messages may contain goals of a planner.
    """

    def __init__(self, allowed: AllowedEndpoint) -> None:
        self._allowed = allowed
        self._type = sent_type(allowed.endpoint)
        self.has_plans = has_plans(self._type)
        is_plain = not has_arrays(self._type)
        floats = [path for path, name in walk_fields(self._type) if name in FLOATS]
        # with a single name it would not return a tuple
        self._read_floats = attrgetter(*floats) if is_plain and len(floats) > 1 else None
        bounds = allowed.endpoint.bounds.items() if is_plain else ()
        self._bounds = [(attrgetter(path), low, high) for path, (low, high) in bounds]

    def check_type(self, message: RosMessage) -> None:
        """As the function."""
        if type(message) is not self._type:
            check_type(self._allowed.endpoint, message)

    def check_finite(self, message: RosMessage) -> None:
        """As the function."""
        read = self._read_floats
        if read is None or not all(map(math.isfinite, read(message))):
            check_finite(self._allowed, message)

    def apply_bounds(self, message: RosMessage) -> tuple[Clamp, ...]:
        """As the function."""
        fits = all(low <= read(message) <= high for read, low, high in self._bounds)
        if fits and len(self._bounds) == len(self._allowed.endpoint.bounds):
            return ()
        return apply_bounds(self._allowed, message)


def check_type(endpoint: Endpoint, message: RosMessage) -> None:
    """Raise RefusedError unless the message has the endpoint's type."""
    part = _PART.get(endpoint.type.split("/")[1])
    came, expected = type_name_of(message), f"{endpoint.type}_{part}" if part else endpoint.type
    if came != expected:
        raise RefusedError(f"A {came} came for endpoint {endpoint.name!r}, which takes {expected}.")


def check_finite(allowed: AllowedEndpoint, message: RosMessage) -> None:
    """Raise RefusedError for a NaN or infinity outside the fields configured for them."""
    path = find_nonfinite(message, allowed.nonfinite)
    if path:
        raise RefusedError(f"{path} is not finite; nothing was sent to {allowed.endpoint.name!r}.")


def apply_bounds(allowed: AllowedEndpoint, message: RosMessage) -> tuple[Clamp, ...]:
    """Raise RefusedError for a value out of bounds; clamp it in the message if configured."""
    clamps = []
    for path, (low, high) in allowed.endpoint.bounds.items():
        for place in find_outside(message, path, low, high):
            if path not in allowed.clamp or math.isnan(place.value):
                raise RefusedError(
                    f"{place.path} is {place.value:g}, allowed is {low:g} .. {high:g}."
                )
            sent = low if place.value < low else high
            place.write(sent)
            clamps.append(Clamp(path=place.path, asked=place.value, sent=sent))
    return tuple(clamps)


def check_steering(endpoint: Endpoint, message: RosMessage) -> None:
    """Raise RefusedError for a velocity that the base cannot execute. Source: `check_twist`."""
    prefix = _TWISTS.get(endpoint.type)
    if prefix is None or endpoint.min_turning_radius_m <= 0.0:
        return
    values = {path: read_number(message, prefix + path) for path in TWIST_FIELDS}
    check_twist(replace(endpoint, bounds={}), values)
