"""Exposed endpoints and their limits, which belong to the topic; some topics are never exposed."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace

from roboneuron.contract import Endpoint, RobotProfile
from roboneuron.direct_path import truth
from roboneuron.direct_path.fields import filled, load_type
from roboneuron.direct_path.message_types import RosMessage
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.modules import settings
from roboneuron.ros import topics
from roboneuron.server.motion_gate import ExposedEndpoint

__all__ = ["ACTING_TOPIC", "LEAD_TOPIC"]
"""Names that other distributions may use."""

_ACTION_TYPE = "std_msgs/msg/Float64MultiArray"
Use = tuple[str, str]
"""Topic and kind."""
SET_PARAMETERS = "rcl_interfaces/srv/SetParameters"
_SERVICE_OF_A_NODE = re.compile(
    r"/(set|get|list|describe)_parameters?(_types|_atomically)?$|/get_type_description$"
    r"|/(change_state|get_state|get_available_states|get_available_transitions|get_transition_graph)$"
)
"""Parameter and lifecycle services. Source: rcl_interfaces/srv, lifecycle_msgs/srv."""
_TRANSITION = re.compile(r"[a-z][a-z0-9_]*/transition_event")
"""Topics that the middleware publishes for each module below a robot's namespace."""
_SYSTEM_TOPICS = frozenset({topics.DIAGNOSTICS, "/rosout", "/parameter_events"})
"""Health of the modules, and topics of ROS itself."""
ACTION_LABEL, POSES_LABEL = "ee_delta", "ee_pose"
"""Labels of the hidden endpoint for the action topic of one arm, and of several: each message
contains targets for all of them.
"""
LEAD_LABEL = "lead"
"""Label of teleoperation's hidden endpoint, whose rows have priority in control."""
LEAD_TOPIC, ACTING_TOPIC = "lead", "acting"
"""Topics of a leading person's rows for control, and of the source that moved the arm, published by
control.
"""
_FARTHEST_M = 10.0
"""Upper bound of a TCP's distance from its base; poses of several arms are in the frame of one of
them.
"""


def allowed_endpoint(exposed: ExposedEndpoint) -> AllowedEndpoint:
    """Create the entry of the gate's allow list."""
    return AllowedEndpoint(
        robot=exposed.robot,
        endpoint=exposed.endpoint,
        profile=exposed.profile,
        clamp=exposed.clamp,
        nonfinite=exposed.nonfinite,
        topic=exposed.topic,
    )


def stop_message(exposed: ExposedEndpoint, now_ns: int) -> RosMessage | None:
    """Return the message that ends a motion, or None."""
    text = exposed.endpoint.stop_message
    if not text:
        return None
    ros_type: type[RosMessage] = load_type(exposed.endpoint.type)
    message = filled(ros_type, {} if text == "zero" else json.loads(text))
    header = getattr(message, "header", None)
    if header is not None and hasattr(header, "stamp"):
        header.stamp.sec, header.stamp.nanosec = divmod(now_ns, 1_000_000_000)
    return message


def profile_endpoints(
    robot: str, namespace: str, profile: RobotProfile | None
) -> list[ExposedEndpoint]:
    """Endpoints in a robot's profile; none without a profile."""
    return [
        ExposedEndpoint(
            robot=robot,
            namespace=namespace,
            label=endpoint.name,
            endpoint=endpoint,
            profile=profile,
        )
        for endpoint in (profile.endpoints if profile is not None else ())
    ]


def action_endpoint(exposed: ExposedEndpoint) -> ExposedEndpoint | None:
    """Return the action topic, which control follows, of the robot of `exposed` if it has a TCP.
    TCP deltas name no arm, so several arms use poses.
    """
    profile = exposed.profile
    if profile is None or not (profile.arm_joints and profile.tcp_link):
        return None
    label, farthest = (POSES_LABEL, _FARTHEST_M) if profile.arms else (ACTION_LABEL, 1.0)
    endpoint = Endpoint(
        name=label,
        kind="publish",
        topic=topics.ACTION,
        type=_ACTION_TYPE,
        summary="TCP poses of all arms for control." if profile.arms else "TCP deltas for control.",
        bounds={"data": (-farthest, farthest)},
        rate_hz=20.0,
    )
    return ExposedEndpoint(
        robot=exposed.robot,
        namespace=exposed.namespace,
        label=label,
        endpoint=endpoint,
        profile=profile,
        hidden=True,
        control_input="action",
    )


def lead_endpoint(exposed: ExposedEndpoint) -> ExposedEndpoint | None:
    """Return the topic by which a person leads the arm of the robot of `exposed`, if it has one."""
    profile = exposed.profile
    if profile is None or not profile.arm_joints:
        return None
    endpoint = Endpoint(
        name=LEAD_LABEL,
        kind="publish",
        topic=LEAD_TOPIC,
        type=_ACTION_TYPE,
        summary="Rows of a person who leads, for control.",
        bounds={"data": (-_FARTHEST_M, _FARTHEST_M)},
        rate_hz=200.0,
    )
    return replace(
        exposed,
        label=LEAD_LABEL,
        endpoint=endpoint,
        hidden=True,
        control_input="lead",
        clamp=frozenset(),
        nonfinite=frozenset(),
        require_subscriber=True,
        moves=True,
    )


def check_stop(exposed: ExposedEndpoint) -> None:
    """Raise ConfigurationError unless the endpoint accepts the stop message."""
    if not exposed.endpoint.stop_message:
        return
    where = f"The stop message of {exposed.endpoint.name!r}"
    if exposed.endpoint.kind != "publish":
        raise ConfigurationError(f"{where} makes no sense: it is a {exposed.endpoint.kind}.")
    try:
        stop_message(exposed, 0)
    except InvalidInputError as error:
        raise ConfigurationError(f"{where}: {error}") from error
    outside = [
        path for path, (low, high) in exposed.endpoint.bounds.items() if not low <= 0.0 <= high
    ]
    if exposed.endpoint.stop_message == "zero" and outside:
        raise ConfigurationError(f"{where} is zero, which the bounds of {outside[0]} do not allow.")


def check_owner(topic: str, robot: str, namespaces: Mapping[str, str]) -> str:
    """Return the known namespace that contains a topic or node; empty for none.

    Args:
        topic: absolute name.
        robot: the robot it is to be exposed for.
        namespaces: robot by ROS namespace (without slashes at the ends).

    Raises:
        ConfigurationError: it belongs to another robot, whose limits and policy would be ignored.
    """
    owner = max(
        (space for space in namespaces if topic.startswith(f"/{space}/")), key=len, default=""
    )
    if owner and namespaces[owner] != robot:
        raise ConfigurationError(
            f"{topic} is of the robot {namespaces[owner]!r}, so it can only be exposed for that "
            "robot.",
            hint=f"Set robot = {namespaces[owner]!r}.",
        )
    return owner


def is_module(node: str, owner: str) -> bool:
    """True if a node in a robot's namespace `owner` is a module of RoboNeuron, whose parameters
    only the supervisor sets.
    """
    return node.removeprefix(f"/{owner}/") in {
        f"{kind}{end}" for kind in settings.MODULE_KINDS for end in ("", "_b")
    }


def check_reserved(exposed: ExposedEndpoint, namespaces: Mapping[str, str]) -> None:
    """Raise ConfigurationError unless this topic may be exposed to agents, and for this robot."""
    topic, kind = exposed.topic, exposed.endpoint.kind
    owner = check_owner(topic, exposed.robot, namespaces)
    where = f"Endpoint {exposed.label!r}: {topic}"
    if kind == "read" and truth.is_withheld(topic):
        raise ConfigurationError(
            f"{where} carries what only the simulator knows, which is not for agents.",
            hint=f"Set {truth.SWITCH}=on for a server that is to tell it.",
        )
    if kind == "read":
        return
    own = topic in _SYSTEM_TOPICS or (
        bool(owner) and _is_own(topic.removeprefix(f"/{owner}/"), exposed.profile)
    )
    if topic.rpartition("/")[2] == settings.EMERGENCY_STOP_TOPIC or (own and kind == "publish"):
        raise ConfigurationError(
            f"{where} is written by RoboNeuron alone and cannot be exposed for kind = {kind!r}.",
            hint="Agents stop the robot with emergency_stop and move an arm with move_ee.",
        )
    # a tool that names the parameters
    is_setting = exposed.hidden and exposed.endpoint.type == SET_PARAMETERS
    if is_setting and owner and is_module(topic.rpartition("/")[0], owner):
        raise ConfigurationError(
            f"{where} belongs to a module of RoboNeuron; only the supervisor sets it."
        )
    if kind == "service" and not is_setting and _SERVICE_OF_A_NODE.search(topic):
        raise ConfigurationError(
            f"{where} is a parameter or lifecycle service and cannot be exposed as such.",
            hint="Use kind = 'parameters', which names the parameters.",
        )


def _is_own(topic: str, profile: RobotProfile | None) -> bool:
    """True if a module, driver or simulation of RoboNeuron publishes a topic in a robot's
    namespace; another publisher could not be told from it.
    """
    if topic in (LEAD_TOPIC, ACTING_TOPIC):
        return True
    if topics.is_written_by_modules(topic) or _TRANSITION.fullmatch(topic):
        return True
    if profile is None:
        return False
    return topic in profile.own_topics or any(
        e.topic == topic for e in profile.endpoints if e.kind == "read"
    )


def by_topic(endpoints: Iterable[ExposedEndpoint]) -> dict[Use, list[ExposedEndpoint]]:
    """Endpoints by topic and kind."""
    found: dict[Use, list[ExposedEndpoint]] = {}
    for exposed in endpoints:
        found.setdefault((exposed.topic, exposed.endpoint.kind), []).append(exposed)
    return found


def tightened_by(endpoint: Endpoint, other: Endpoint) -> Endpoint:
    """Return the endpoint with the limits of another endpoint of the same topic added.

    Raises:
        ConfigurationError: together they allow nothing, or the types differ.
    """
    if other is endpoint:
        return endpoint
    where = f"Endpoints {other.name!r} and {endpoint.name!r} are both {endpoint.topic!r}"
    if endpoint.type != other.type:
        raise ConfigurationError(f"{where}, but of {other.type} and {endpoint.type}.")
    bounds = dict(endpoint.bounds)
    for path, (low, high) in other.bounds.items():
        lowest, highest = bounds.get(path, (-math.inf, math.inf))
        bounds[path] = (max(low, lowest), min(high, highest))
        if bounds[path][0] > bounds[path][1]:
            raise ConfigurationError(f"{where}; no value of {path} is within the bounds of both.")
    if endpoint.frame and other.frame and endpoint.frame != other.frame:
        raise ConfigurationError(
            f"{where}, with limits of place in {other.frame!r} and in {endpoint.frame!r}."
        )
    rates = [rate for rate in (endpoint.rate_hz, other.rate_hz) if rate]
    return replace(
        endpoint,
        bounds=bounds,
        rate_hz=min(rates, default=0.0),
        joint_limited=endpoint.joint_limited or other.joint_limited,
        min_turning_radius_m=max(endpoint.min_turning_radius_m, other.min_turning_radius_m),
        stop_message=endpoint.stop_message or other.stop_message,
        frame=endpoint.frame or other.frame,
        zones=(*endpoint.zones, *(zone for zone in other.zones if zone not in endpoint.zones)),
    )


def same_for_each_topic(
    drafts: Iterable[ExposedEndpoint], sources: Mapping[Use, Iterable[ExposedEndpoint]]
) -> list[ExposedEndpoint]:
    """Give every endpoint of a topic the limits of all endpoints of that topic.

    Args:
        drafts: exposed endpoints; one moves the robot if any endpoint of its topic does, and
            accepts only what all accept.
        sources: additional endpoints with limits on the topics, exposed or not.
    """
    listed = list(drafts)
    names = by_topic(listed)
    made = []
    for draft in listed:
        use = draft.topic, draft.endpoint.kind
        endpoint = draft.endpoint
        for source in (*names[use], *sources.get(use, ())):
            endpoint = tightened_by(endpoint, source.endpoint)
        nonfinite = frozenset.intersection(*(e.nonfinite for e in names[use]))
        moves = any(e.moves for e in names[use])
        made.append(replace(draft, endpoint=endpoint, moves=moves, nonfinite=nonfinite))
    return made
