"""Lists and messages are cut to what an agent can read, and say how much is left out."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import anyio

from roboneuron.contract import Endpoint
from roboneuron.feature import ExposedEndpoint
from roboneuron.ros.graph import RosGraph
from roboneuron.tools.ros.exposure import Exposure
from roboneuron.tools.ros.generic import ListNames, generic_tools
from roboneuron.tools.ros.graph import GraphNames
from roboneuron.tools.ros.read import newest

COUNT = 130


class Graph:
    """A graph of many nodes."""

    def get_topic_names_and_types(self) -> list[Any]:
        return []

    get_service_names_and_types = get_topic_names_and_types

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        return [(f"node_{number}", "/arm") for number in range(COUNT)]

    def get_publishers_info_by_topic(self, topic: str, no_mangle: bool) -> list[Any]:
        return []

    get_subscriptions_info_by_topic = get_publishers_info_by_topic

    def count_publishers(self, topic: str) -> int:
        return 0

    count_subscribers = count_publishers


def exposed(number: int) -> ExposedEndpoint:
    endpoint = Endpoint(
        name=f"t{number}", kind="read", topic=f"t{number}", type="std_msgs/msg/Bool", summary="One."
    )
    return ExposedEndpoint(robot="arm", namespace="arm", label=endpoint.name, endpoint=endpoint)


def ask(name: str, **arguments: Any) -> Any:
    exposure = Exposure(endpoints=tuple(map(exposed, range(COUNT))))
    host: Any = SimpleNamespace(graph=RosGraph(Graph()))
    tools: list[Any] = generic_tools(lambda: exposure, GraphNames(host))
    handler = next(tool.handler for tool in tools if tool.name == name)

    async def run(work: Any) -> Any:
        return work(None)

    async def call() -> Any:
        return await handler(ListNames(**arguments), SimpleNamespace(run=run))

    return anyio.run(call)


def test_topics_are_cut_and_narrowed() -> None:
    found = ask("list_topics")
    assert (len(found.topics), found.more) == (50, COUNT - 50)
    narrow = ask("list_topics", contains="t12")
    assert {topic.name for topic in narrow.topics} == {
        "t12",
        *(f"t12{digit}" for digit in range(10)),
    }
    assert narrow.more == 0


def test_nodes_are_cut_and_narrowed() -> None:
    found = ask("list_nodes", entries=7)
    assert (len(found.nodes), found.more) == (7, COUNT - 7)
    assert ask("list_nodes", contains="node_129").nodes == ["/arm/node_129"]


def test_the_newest_messages_are_kept() -> None:
    messages = [{"number": number, "text": "x" * 1000} for number in range(100)]
    kept = newest(messages)
    assert kept == messages[-len(kept) :]
    assert 20 < len(kept) < 100
    assert len(json.dumps(kept)) < 32_000
    assert newest([{"text": "x" * 100_000}]) == [{"text": "x" * 100_000}], "one is always given"
