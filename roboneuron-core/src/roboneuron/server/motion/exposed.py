"""Endpoints that agents may use: what the gate, the publishers and the tools know of each."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

from roboneuron.contract import Endpoint, RobotProfile
from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.gate import AllowedEndpoint
from roboneuron.gate.joints import JOINT_TYPES
from roboneuron.gate.limits import sent_types
from roboneuron.interfaces import Interface, MessageInterface, load_interface
from roboneuron.ros.topics import ACTION

_VELOCITIES = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
_ACTION_TYPE = "std_msgs/msg/Float64MultiArray"
ACTION_LABEL = "ee_delta"
"""Label of the hidden endpoint that is the action topic of an arm."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Exposed:
    """An endpoint of one robot that agents may use.

    Attributes:
        robot: its name.
        namespace: its ROS namespace, without a leading slash.
        label: noun in the names of its tools.
        endpoint: the gate's entry; its name is unique among the robot's.
        interface: the type.
        profile: the robot's facts, None for a robot that no plugin knows.
        clamp, nonfinite: see `AllowedEndpoint`.
        require_subscriber: a message that nobody receives is an error.
        moves: it moves the robot, so that it is refused while a policy does.
        hidden: no tools of its own; another tool uses it.
    """

    robot: str
    namespace: str
    label: str
    endpoint: Endpoint
    interface: Interface
    profile: RobotProfile | None = None
    clamp: frozenset[str] = frozenset()
    nonfinite: frozenset[str] = frozenset()
    require_subscriber: bool = True
    moves: bool = True
    hidden: bool = False

    @property
    def topic(self) -> str:
        """Absolute name of the topic, service or action."""
        name = self.endpoint.topic
        return name if name.startswith("/") else f"/{self.namespace}/{name}"

    @property
    def message(self) -> MessageInterface:
        """The type as a message; only for topics."""
        assert isinstance(self.interface, MessageInterface)
        return self.interface

    def allowed(self) -> AllowedEndpoint:
        """The entry of the gate's allow list."""
        return AllowedEndpoint(
            robot=self.robot,
            endpoint=self.endpoint,
            profile=self.profile,
            clamp=self.clamp,
            nonfinite=self.nonfinite,
            topic=self.topic,
        )

    def stop_message(self, now_ns: int) -> Any:
        """The message that ends a motion, or None."""
        text = self.endpoint.stop_message
        if not text:
            return None
        if text != "zero":
            return self.message.encode(json.loads(text), now_ns=now_ns)
        message = self.message.ros_type()
        header = getattr(message, "header", None)
        if header is not None and hasattr(header, "stamp"):
            header.stamp.sec, header.stamp.nanosec = divmod(now_ns, 1_000_000_000)
        return message


def profile_endpoints(robot: str, namespace: str, profile: RobotProfile | None) -> list[Exposed]:
    """The endpoints that a robot's profile offers; none without a profile."""
    return [
        Exposed(
            robot=robot,
            namespace=namespace,
            label=endpoint.name,
            endpoint=endpoint,
            interface=load_interface(endpoint.type),
            profile=profile,
        )
        for endpoint in (profile.endpoints if profile is not None else ())
    ]


def action_endpoint(exposed: Exposed) -> Exposed | None:
    """The action topic of the robot of `exposed`, when that is an arm with a TCP: what control follows."""
    profile = exposed.profile
    if profile is None or not (profile.arm_joints and profile.tcp_link):
        return None
    endpoint = Endpoint(
        name=ACTION_LABEL, kind="publish", topic=ACTION, type=_ACTION_TYPE, summary="TCP deltas for control.",
        bounds={"data": (-1.0, 1.0)}, rate_hz=20.0,
    )  # fmt: skip
    return Exposed(
        robot=exposed.robot, namespace=exposed.namespace, label=ACTION_LABEL, endpoint=endpoint,
        interface=load_interface(_ACTION_TYPE), profile=profile, hidden=True,
    )  # fmt: skip


def is_velocity_type(kind: str, type_name: str) -> bool:
    """Whether a robot goes on at what it was told until it is told something else, so that it has to end in zero."""
    return kind == "publish" and type_name in _VELOCITIES


def is_joint_limited(kind: str, type_name: str, profile: RobotProfile | None) -> bool:
    """Whether a new endpoint takes joint commands, alone or in a goal or request, of a robot with joint limits."""
    if kind == "read" or profile is None or profile.limits is None:
        return False
    return type_name in JOINT_TYPES or any(name in JOINT_TYPES for name in sent_types(kind, type_name))


def renamed(exposed: Exposed, name: str) -> Exposed:
    """The same endpoint under another name in the allow list."""
    return replace(exposed, endpoint=replace(exposed.endpoint, name=name))


def check_stop(exposed: Exposed) -> None:
    """Raise ConfigurationError unless the stop message is one that the endpoint takes."""
    if not exposed.endpoint.stop_message:
        return
    where = f"The stop message of {exposed.endpoint.name!r}"
    if exposed.endpoint.kind != "publish":
        raise ConfigurationError(f"{where} makes no sense: it is a {exposed.endpoint.kind}.")
    try:
        exposed.stop_message(0)
    except InvalidInputError as error:
        raise ConfigurationError(f"{where}: {error}") from error
    outside = [path for path, (low, high) in exposed.endpoint.bounds.items() if not low <= 0.0 <= high]
    if exposed.endpoint.stop_message == "zero" and outside:
        raise ConfigurationError(f"{where} is zero, which the bounds of {outside[0]} do not allow.")
