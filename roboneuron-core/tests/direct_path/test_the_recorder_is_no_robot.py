"""The server's own recorder subscribes to what is sent, and is not what a message is for."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from roboneuron.direct_path import writer as writer_module
from roboneuron.direct_path.writer import TopicWriter

TYPE = "geometry_msgs/msg/Twist"


class Graph:
    """A node that has discovered subscriptions, and a publisher that matched them."""

    def __init__(self) -> None:
        self.nodes: list[tuple[str, str]] = []
        self.looks = 0

    def get_subscriptions_info_by_topic(self, topic: str) -> list[Any]:
        self.looks += 1
        return [
            SimpleNamespace(topic_type=TYPE, node_namespace=namespace, node_name=name)
            for namespace, name in self.nodes
        ]

    def get_subscription_count(self) -> int:
        return len(self.nodes)


@pytest.fixture
def graph() -> Graph:
    return Graph()


@pytest.fixture
def writer(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> TopicWriter:
    monkeypatch.setattr(writer_module, "check_type_hash", lambda *_: None)
    link: Any = SimpleNamespace(node=graph)
    made = TopicWriter(link, object, TYPE, "/arm/cmd_vel")
    made._publisher = graph  # type: ignore[assignment]
    return made


def test_a_recorder_alone_is_nobody(graph: Graph, writer: TopicWriter) -> None:
    graph.nodes = [("/", "recorder_4711")]
    assert (writer.matched(), writer.listening()) == (0, 0)
    graph.nodes.append(("/arm", "robot"))
    assert (writer.matched(), writer.listening()) == (1, 1)
    graph.nodes.remove(("/arm", "robot"))
    assert writer.matched() == 0


def test_a_node_of_another_namespace_may_be_called_so(graph: Graph, writer: TopicWriter) -> None:
    graph.nodes = [("/arm", "recorder_1"), ("/", "recorder_of_somebody")]
    assert writer.matched() == 2


def test_a_name_that_comes_later_is_looked_up_again(graph: Graph, writer: TopicWriter) -> None:
    graph.nodes = [("_NODE_NAMESPACE_UNKNOWN_", "_NODE_NAME_UNKNOWN_")]
    assert writer.matched() == 1
    graph.nodes = [("/", "recorder_4711")]
    assert writer.matched() == 0


def test_nothing_is_looked_up_while_no_subscription_comes_or_goes(
    graph: Graph, writer: TopicWriter
) -> None:
    graph.nodes = [("/arm", "robot"), ("/", "recorder_4711")]
    for _ in range(5):
        assert writer.matched() == 1
    assert graph.looks == 1


@pytest.mark.parametrize(("named_after", "waits"), [(3, 3), (None, 200)])
def test_a_message_waits_for_subscriptions_whose_process_has_not_discovered_this_one(
    graph: Graph,
    writer: TopicWriter,
    monkeypatch: pytest.MonkeyPatch,
    named_after: int | None,
    waits: int,
) -> None:
    """Names of ROS 2 Humble never come."""
    graph.nodes = [("_NODE_NAMESPACE_UNKNOWN_", "_NODE_NAME_UNKNOWN_")]
    waits_s: list[float] = []

    def sleep(duration_s: float) -> None:
        waits_s.append(duration_s)
        if len(waits_s) == named_after:
            graph.nodes = [("/arm", "robot")]

    clock = SimpleNamespace(monotonic=lambda: 0.005 * len(waits_s), sleep=sleep)
    monkeypatch.setattr(writer_module, "time", clock)
    writer._await_other_side()
    assert waits_s == [0.005] * waits + [0.03]
