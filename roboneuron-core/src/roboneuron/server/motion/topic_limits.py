"""Limits belong to a topic, not to a name: two names of one topic share every limit. Some topics are never exposed."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from roboneuron.contract import Endpoint
from roboneuron.errors import ConfigurationError
from roboneuron.modules.settings import EMERGENCY_STOP_TOPIC, MODULE_KINDS
from roboneuron.ros.topics import ACTION, EE_POSE, JOINT_STATES

if TYPE_CHECKING:
    from roboneuron.server.motion.exposed import Exposed

Use = tuple[str, str]
"""Topic and kind."""
SET_PARAMETERS = "rcl_interfaces/srv/SetParameters"
_SERVICE_OF_A_NODE = re.compile(
    r"/(set|get|list|describe)_parameters?(_types|_atomically)?$|/get_type_description$"
    r"|/(change_state|get_state|get_available_states|get_available_transitions|get_transition_graph)$"
)
"""Parameter and lifecycle services. Source: rcl_interfaces/srv, lifecycle_msgs/srv."""
_OWN_TOPICS = frozenset({ACTION, JOINT_STATES, EE_POSE})
"""Written by RoboNeuron's own modules below a robot's namespace; a second writer would pass for them."""


def check_owner(topic: str, robot: str, namespaces: Mapping[str, str]) -> str:
    """Return the namespace that a topic or node lies in, of those that are known; empty for none.

    Args:
        topic: absolute name.
        robot: the robot it is to be exposed for.
        namespaces: robot by ROS namespace (without slashes at the ends).

    Raises:
        ConfigurationError: it is another robot's, whose limits and whose policy would not count.
    """
    owner = max((space for space in namespaces if topic.startswith(f"/{space}/")), key=len, default="")
    if owner and namespaces[owner] != robot:
        raise ConfigurationError(
            f"{topic} is of the robot {namespaces[owner]!r}, so it can only be exposed for that robot.",
            hint=f"Set robot = {namespaces[owner]!r}.",
        )
    return owner


def is_module(node: str, owner: str) -> bool:
    """Whether a node in a robot's namespace `owner` is a module of RoboNeuron, which the supervisor alone sets."""
    return node.removeprefix(f"/{owner}/") in {f"{kind}{end}" for kind in MODULE_KINDS for end in ("", "_b")}


def check_reserved(exposed: Exposed, namespaces: Mapping[str, str]) -> None:
    """Raise ConfigurationError unless agents may be given this topic, and through this robot."""
    topic, kind = exposed.topic, exposed.endpoint.kind
    owner = check_owner(topic, exposed.robot, namespaces)
    if kind == "read":
        return
    where = f"Endpoint {exposed.label!r}: {topic}"
    own = bool(owner) and topic.removeprefix(f"/{owner}/") in _OWN_TOPICS
    if topic.rpartition("/")[2] == EMERGENCY_STOP_TOPIC or (own and kind == "publish"):
        raise ConfigurationError(
            f"{where} is written by RoboNeuron alone and cannot be exposed for kind = {kind!r}.",
            hint="Agents stop the robot with emergency_stop and move an arm with move_ee.",
        )
    is_setting = exposed.hidden and exposed.endpoint.type == SET_PARAMETERS  # a tool that names the parameters
    if is_setting and owner and is_module(topic.rpartition("/")[0], owner):
        raise ConfigurationError(f"{where} is of a module of RoboNeuron, which the supervisor alone sets.")
    if kind == "service" and not is_setting and _SERVICE_OF_A_NODE.search(topic):
        raise ConfigurationError(
            f"{where} is a parameter or lifecycle service and cannot be exposed as such.",
            hint="Use kind = 'parameters', which names the parameters.",
        )


def by_topic(endpoints: Iterable[Exposed]) -> dict[Use, list[Exposed]]:
    """Endpoints by topic and kind."""
    found: dict[Use, list[Exposed]] = {}
    for exposed in endpoints:
        found.setdefault((exposed.topic, exposed.endpoint.kind), []).append(exposed)
    return found


def tightened_by(endpoint: Endpoint, other: Endpoint) -> Endpoint:
    """The endpoint with the limits of another name of the same topic as well.

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
    rates = [rate for rate in (endpoint.rate_hz, other.rate_hz) if rate]
    return replace(
        endpoint,
        bounds=bounds,
        rate_hz=min(rates, default=0.0),
        joint_limited=endpoint.joint_limited or other.joint_limited,
        min_turning_radius_m=max(endpoint.min_turning_radius_m, other.min_turning_radius_m),
        stop_message=endpoint.stop_message or other.stop_message,
    )


def same_for_each_topic(drafts: Iterable[Exposed], sources: Mapping[Use, Iterable[Exposed]]) -> list[Exposed]:
    """Every name of a topic with the limits of all of them.

    Args:
        drafts: what is exposed; it moves the robot if one of its names does, and takes only what all may hold.
        sources: more that limits topics, exposed or not.
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


def not_looser(drafts: Iterable[Exposed], before: Mapping[Use, Sequence[Exposed]]) -> Iterator[Exposed]:
    """Run time may neither free a topic of the configuration of the policy, nor let it hold more than it did."""
    for draft in drafts:
        same = before.get((draft.topic, draft.endpoint.kind), ())
        yield same_for_each_topic([draft, *same], {})[0] if same else draft
