"""A foreign node's topic that this process cannot subscribe to ends no recording."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rn_recorder_runs.files import Record
from rn_testing.waiting import wait_until
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]
OWN = "/own"
"""The recorder's process uses it with a type that comes after the foreign one by name."""


@pytest.fixture
def nodes(tmp_path: Path) -> Iterator[list[object]]:
    """The recorder's node and a foreign one, each in a context of its own."""
    prepare_environment(tmp_path / "ros")
    import rclpy
    from rclpy.node import Node

    contexts = [rclpy.Context() for _ in range(2)]
    for context in contexts:
        rclpy.init(context=context)
    made = [Node(f"node_{n}", context=context) for n, context in enumerate(contexts)]
    yield list(made)
    for node, context in zip(made, contexts, strict=True):
        node.destroy_node()
        context.shutdown()


def test_the_other_topics_are_recorded(
    nodes: list[object], caplog: pytest.LogCaptureFixture
) -> None:
    from std_msgs.msg import Bool, String

    from rn_recorder_runs.tap import TopicTap

    own, foreign = nodes
    records: list[Record] = []
    tap = TopicTap(own, ["/*"], [], records.append)  # type: ignore[arg-type]
    own.create_publisher(String, OWN, 1)  # type: ignore[attr-defined]
    foreign.create_publisher(Bool, OWN, 1)  # type: ignore[attr-defined]
    good = foreign.create_publisher(Bool, "/good", 1)  # type: ignore[attr-defined]
    names = own.get_topic_names_and_types  # type: ignore[attr-defined]
    wait_until(lambda: len(dict(names()).get(OWN, ())) == 2, 20.0, "the topic has one type")
    leaving = threading.Event()

    def taken() -> None:
        good.publish(Bool(data=True))
        if any(record.topic == "/good" for record in records):
            leaving.set()

    with caplog.at_level(logging.WARNING):
        tap.run(leaving, taken)
    assert [r.getMessage() for r in caplog.records if OWN in r.getMessage()], "it is not named"
