"""Endpoints that agents may use: what the gate, the publishers and the tools know of each."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from roboneuron.contract import Endpoint, RobotProfile
from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.gate import AllowedEndpoint
from roboneuron.gate.fields import filled, load_type
from roboneuron.ros.topics import ACTION

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
    def ros_type(self) -> Any:
        """The rosidl class of its type. Raises ConfigurationError."""
        return load_type(self.endpoint.type)

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
        message = filled(self.ros_type, {} if text == "zero" else json.loads(text))
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
        profile=profile, hidden=True,
    )  # fmt: skip


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
