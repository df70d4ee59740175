"""Interface types of exposed endpoints, and the limits that follow from a type."""

from __future__ import annotations

from dataclasses import replace

from roboneuron.contract import Endpoint, RobotProfile
from roboneuron.direct_path.fields import FLOATS, INTEGERS, walk_fields
from roboneuron.direct_path.joint_messages import JOINT_TYPES
from roboneuron.direct_path.limits import sent_type
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.tools.ros.interfaces import (
    ActionInterface,
    Interface,
    MessageInterface,
    ServiceInterface,
    load_interface,
)

_VELOCITIES = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
_TIMES = ("builtin_interfaces/Time", "builtin_interfaces/Duration", "std_msgs/Header")


def interface_of(exposed: ExposedEndpoint) -> Interface:
    """Return the interface of an endpoint. Raises ConfigurationError."""
    return load_interface(exposed.endpoint.type, nonfinite=exposed.nonfinite)


def message_of(exposed: ExposedEndpoint) -> MessageInterface:
    """Return the interface of a topic."""
    interface = interface_of(exposed)
    assert isinstance(interface, MessageInterface)
    return interface


def service_of(exposed: ExposedEndpoint) -> ServiceInterface:
    """Return the interface of a service."""
    interface = interface_of(exposed)
    assert isinstance(interface, ServiceInterface)
    return interface


def action_of(exposed: ExposedEndpoint) -> ActionInterface:
    """Return the interface of an action."""
    interface = interface_of(exposed)
    assert isinstance(interface, ActionInterface)
    return interface


def number_fields(endpoint: Endpoint) -> list[str]:
    """Paths of all numbers that may be sent to an endpoint, except times and headers, which move
    nothing.
    """
    numbers: list[str] = []
    times: list[str] = []
    for path, element in walk_fields(sent_type(endpoint)):
        if element in _TIMES:
            times.append(f"{path}.")
        elif element in FLOATS | INTEGERS and not path.startswith(tuple(times)):
            numbers.append(path)
    return numbers


def sent_types(kind: str, type_name: str) -> set[str]:
    """Types of the messages nested in those sent to an endpoint of this kind and type."""
    sent = sent_type(Endpoint(name="", kind=kind, topic="", type=type_name, summary=""))
    return {element.replace("/", "/msg/") for _, element in walk_fields(sent) if "/" in element}


def is_velocity_type(kind: str, type_name: str) -> bool:
    """True if a robot follows a command until the next one, so that a motion must end with zero."""
    return kind == "publish" and type_name in _VELOCITIES


def is_joint_limited(kind: str, type_name: str, profile: RobotProfile | None) -> bool:
    """True if a new endpoint accepts joint commands, alone or in a goal or request, for a robot
    with joint limits.
    """
    if kind == "read" or profile is None or profile.limits is None:
        return False
    return type_name in JOINT_TYPES or any(
        name in JOINT_TYPES for name in sent_types(kind, type_name)
    )


def renamed(exposed: ExposedEndpoint, name: str) -> ExposedEndpoint:
    """Copy the endpoint with another name in the allow list."""
    return replace(exposed, endpoint=replace(exposed.endpoint, name=name))
