"""Tools list_interfaces, describe_interface, list_topics and list_nodes, restricted to exposed
endpoints.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable
from typing import TypeVar

from pydantic import Field

from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.server.tool import Arguments, CallContext, Result, Tool
from roboneuron.tools.ros.exposure import Exposure
from roboneuron.tools.ros.graph import GraphNames
from roboneuron.tools.ros.interfaces import (
    ActionInterface,
    Interface,
    ServiceInterface,
    list_interfaces,
    load_interface,
)

_MOST_NAMES = 300


class ListInterfaces(Arguments):
    """Arguments of list_interfaces."""

    package: str = Field(
        default="", max_length=100, description="Only those of this package, such as geometry_msgs."
    )


class InterfaceNames(Result):
    """Names of interfaces."""

    interfaces: list[str]
    more: int = Field(description="names that are left out; name a `package`")


class DescribeInterface(Arguments):
    """Arguments of describe_interface."""

    type: str = Field(
        max_length=200, description="Such as geometry_msgs/msg/Twist or std_srvs/srv/SetBool."
    )


class InterfaceDescription(Result):
    """An interface as JSON schemas."""

    name: str
    kind: str = Field(description="msg, srv or action")
    parts: dict[str, dict[str, object]] = Field(
        description="JSON schema by part: message; request, response; goal, result, feedback"
    )


class TopicStatus(Result):
    """An exposed topic, service or action, and its present state in the ROS graph."""

    robot: str
    name: str = Field(description="noun in the tools' names")
    kind: str
    topic: str
    type: str
    live_type: str = Field(description="type in the graph; empty when unused")
    publishers: int | None = Field(description="None for services and actions")
    subscribers: int | None
    served: bool | None = Field(description="whether it has a server; None for topics")
    problems: list[str] = Field(
        description="what does not fit: definition, quality of service, ROS or DDS"
    )


class ListNames(Arguments):
    """Arguments of list_topics and list_nodes."""

    contains: str = Field(
        default="", max_length=200, description="Only names that contain this text."
    )
    entries: int = Field(default=50, ge=1, le=200, description="Most entries.")


class TopicList(Result):
    """Exposed endpoints."""

    topics: list[TopicStatus]
    more: int = Field(
        description="entries that fit the call and are left out; `contains` narrows it"
    )


class NodeList(Result):
    """Nodes of the exposed robots."""

    nodes: list[str]
    more: int = Field(
        description="entries that fit the call and are left out; `contains` narrows it"
    )


def generic_tools(exposure: Callable[[], Exposure], graph: GraphNames) -> list[Tool]:
    """Create the four tools for the endpoints exposed at the time of the call."""

    async def interfaces(arguments: ListInterfaces, context: CallContext) -> InterfaceNames:
        found = list_interfaces(arguments.package or None)
        if not found:
            raise InvalidInputError(
                f"No installed package {arguments.package!r} holds interfaces.", path="package"
            )
        names = [str(name) for name in found]
        return InterfaceNames(interfaces=names[:_MOST_NAMES], more=max(0, len(names) - _MOST_NAMES))

    async def describe(arguments: DescribeInterface, context: CallContext) -> InterfaceDescription:
        try:
            return await context.run(lambda _: _describe(load_interface(arguments.type)))
        except ConfigurationError as error:
            raise InvalidInputError(error.message, hint=error.hint, path="type") from error

    async def topics(arguments: ListNames, context: CallContext) -> TopicList:
        found = [
            e
            for e in exposure().endpoints
            if arguments.contains in e.topic or arguments.contains in e.label
        ]
        kept = found[: arguments.entries]
        listed = await context.run(lambda _: _topics(kept, graph))
        return TopicList(topics=listed, more=len(found) - len(kept))

    async def nodes(arguments: ListNames, context: CallContext) -> NodeList:
        found = [
            n
            for n in await context.run(lambda _: _nodes(exposure(), graph))
            if arguments.contains in n
        ]
        return NodeList(
            nodes=found[: arguments.entries], more=max(0, len(found) - arguments.entries)
        )

    return [
        _reading(
            "list_interfaces",
            "List ROS interfaces",
            "Names of the installed ROS messages, services and actions.",
            ListInterfaces,
            InterfaceNames,
            interfaces,
        ),
        _reading(
            "describe_interface",
            "Describe a ROS interface",
            "Fields, types, limits, "
            "defaults and constants of a "
            "ROS message, service or action, as JSON schema.",
            DescribeInterface,
            InterfaceDescription,
            describe,
        ),
        _reading(
            "list_topics",
            "List exposed topics",
            "Topics, services and actions that may be "
            "used, each with what "
            "the ROS graph shows of it now: type, publishers, subscribers.",
            ListNames,
            TopicList,
            topics,
        ),
        _reading(
            "list_nodes",
            "List nodes",
            "ROS nodes of the exposed robots, or with exposed parameters, that run now.",
            ListNames,
            NodeList,
            nodes,
        ),
    ]


A = TypeVar("A", bound=Arguments)


def _reading(
    name: str,
    title: str,
    description: str,
    arguments: type[A],
    result: type[Result],
    handler: Callable[[A, CallContext], Awaitable[Result]],
) -> Tool[A]:
    return Tool(
        name=name,
        title=title,
        description=description,
        arguments=arguments,
        result=result,
        handler=handler,
        read_only=True,
        idempotent=True,
        seldom=True,
    )


def _describe(interface: Interface) -> InterfaceDescription:
    if isinstance(interface, ServiceInterface):
        parts = {"request": interface.request, "response": interface.response}
    elif isinstance(interface, ActionInterface):
        parts = {"goal": interface.goal, "result": interface.result, "feedback": interface.feedback}
    else:
        parts = {"message": interface}
    schemas = {word: part.json_schema() for word, part in parts.items()}
    return InterfaceDescription(name=interface.name, kind=interface.kind, parts=schemas)


def _topics(endpoints: Iterable[ExposedEndpoint], graph: GraphNames) -> list[TopicStatus]:
    live = {"service": graph.services(), "action": graph.actions()}
    topics = graph.topics()
    listed = []
    for exposed in endpoints:
        kind, name = exposed.endpoint.kind, exposed.topic
        is_topic = kind in ("publish", "read")
        publishers, subscribers = graph.counts(name) if is_topic else (None, None)
        types = (topics if is_topic else live[kind]).get(name, [])
        listed.append(
            TopicStatus(
                robot=exposed.robot,
                name=exposed.label,
                kind=kind,
                topic=name,
                type=exposed.endpoint.type,
                live_type=", ".join(types),
                publishers=publishers,
                subscribers=subscribers,
                served=None if is_topic else bool(types),
                problems=graph.problems(exposed),
            )
        )
    return listed


def _nodes(exposure: Exposure, graph: GraphNames) -> list[str]:
    spaces = {f"/{exposed.namespace}/" for exposed in exposure.endpoints}
    named = {node.node for node in exposure.nodes}
    return [n for n in graph.nodes() if n in named or any(n.startswith(space) for space in spaces)]
