"""Nodes with exposed parameters, by name, and the limits for agents."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from roboneuron.direct_path.exposed import check_owner, is_module
from roboneuron.errors import ConfigurationError
from roboneuron.tools.ros.options import ExposeConfig

_NAME = re.compile(r"[!-~]{1,200}")


@dataclass(frozen=True, kw_only=True, slots=True)
class ParameterNode:
    """A node with parameters that agents may read and set.

    Attributes:
        robot, namespace: its robot.
        name: name for agents.
        node: absolute name.
        names: the exposed parameters.
        bounds: lowest and highest value by parameter.
        moves: setting them may move the robot.
        rate_hz: most settings per second; 0 for no bound.
    """

    robot: str
    namespace: str
    name: str
    node: str
    names: frozenset[str]
    bounds: dict[str, tuple[float, float]]
    moves: bool
    rate_hz: float


def parameter_node(entry: ExposeConfig, robot: str, namespace: str) -> ParameterNode:
    """Create the node of an entry of kind "parameters".

    Raises:
        ConfigurationError: it names no node, or no parameter.
    """
    if entry.name is None or entry.topic is None:
        raise ConfigurationError(
            "[[expose]] with kind = 'parameters' needs `name` and `topic` (the node)."
        )
    names = frozenset((*entry.parameters, *entry.bounds))
    if not names:
        raise ConfigurationError(
            f"[[expose]] {entry.name!r} names no parameter of {entry.topic!r}.",
            hint='List them: parameters = ["gain"]; those in `bounds` count too.',
        )
    for name in sorted(names):
        check_parameter_name(name)
    return ParameterNode(
        robot=robot,
        namespace=namespace,
        name=entry.name,
        node=entry.topic if entry.topic.startswith("/") else f"/{namespace}/{entry.topic}",
        names=names,
        bounds={path: (low, high) for path, (low, high) in entry.bounds.items()},
        moves=entry.moves,
        rate_hz=entry.rate_hz or 0.0,
    )


def check_parameter_name(name: str) -> None:
    """Check that a parameter's name is unambiguous: ROS ends it at a NUL, other software normalises
    it.

    Raises:
        ConfigurationError: it contains anything but printable ASCII without spaces, or is longer
            than 200 characters.
    """
    if not _NAME.fullmatch(name):
        raise ConfigurationError(
            f"{name[:60]!a} is no name of a parameter: printable ASCII without spaces."
        )


def check_parameter_node(node: ParameterNode, namespaces: Mapping[str, str]) -> None:
    """Raise ConfigurationError for another robot's node, and for a module, whose parameters only
    the supervisor sets.
    """
    owner = check_owner(node.node, node.robot, namespaces)
    if owner and is_module(node.node, owner):
        raise ConfigurationError(
            f"The parameters of {node.node}, a module of RoboNeuron, cannot be exposed."
        )


def same_for_each_node(
    nodes: Sequence[ParameterNode], namespaces: Mapping[str, str]
) -> list[ParameterNode]:
    """Give every entry of a node the bounds, the rate and the motion of all its entries.

    Args:
        nodes: the exposed nodes.
        namespaces: robot by ROS namespace.

    Raises:
        ConfigurationError: two bounds of one parameter do not overlap, or the node is a module or
            another robot's.
    """
    made = []
    for node in nodes:
        check_parameter_node(node, namespaces)
        names = [other for other in nodes if other.node == node.node]
        bounds = dict(node.bounds)
        for path, (low, high) in (
            (path, span) for other in names for path, span in other.bounds.items()
        ):
            lowest, highest = bounds.get(path, (-math.inf, math.inf))
            bounds[path] = (max(low, lowest), min(high, highest))
            if bounds[path][0] > bounds[path][1]:
                raise ConfigurationError(
                    f"No value of {path!r} of {node.node} is within both of its bounds."
                )
        rates = [other.rate_hz for other in names if other.rate_hz]
        moves = any(other.moves for other in names)
        made.append(replace(node, bounds=bounds, rate_hz=min(rates, default=0.0), moves=moves))
    return made
