"""Learnt messages, services and actions through plain rclpy, beside what strangers send."""

from __future__ import annotations

import random
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
import rclpy
from made_messages import filled
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message

from rn_interfaces.finder import PREFIXES
from rn_interfaces.graph import hashes_here
from rn_interfaces.store import DefinitionStore, Name
from rn_interfaces_learning.nodes import NodeGraph, ask_nodes
from rn_testing.domain import free_ros_domain
from rn_testing.waiting import holds_within, wait_until
from roboneuron.ros.environment import prepare_environment
from roboneuron.ros.link import RosLink

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]
SEAM = Name("weld_msgs", "msg", "Seam")
WAIT_S = 60.0
"""For what another thread or process does, on a machine that does much else."""


@pytest.fixture
def node(store: DefinitionStore, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    """A node that four threads spin, in a domain without nodes of other tests."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    prepare_environment(tmp_path)
    context = rclpy.Context()
    rclpy.init(context=context)
    made = Node("welder", context=context)
    executor = MultiThreadedExecutor(4, context=context)
    executor.add_node(made)

    def spin() -> None:
        with suppress(ExternalShutdownException, InvalidHandle):
            executor.spin()

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    yield made
    executor.shutdown(timeout_sec=2.0)
    thread.join(5.0)
    made.destroy_node()
    context.try_shutdown()


def result_of(future: Any) -> Any:
    """What a future becomes."""
    wait_until(future.done, WAIT_S)
    return future.result()


def test_topic_service_and_action_carry_learnt_types(node: Node) -> None:
    from weld_msgs.action import Weld
    from weld_msgs.msg import Path, Seam
    from weld_msgs.srv import Strike

    group = ReentrantCallbackGroup()
    got: list[Path] = []
    node.create_subscription(Path, "/path", got.append, 10, callback_group=group)
    publisher = node.create_publisher(Path, "/path", 10)
    wait_until(lambda: publisher.get_subscription_count() == 1, WAIT_S)
    sent = filled(Path, random.Random(1))
    publisher.publish(sent)
    wait_until(lambda: got == [sent], WAIT_S)

    def strike(request: Strike.Request, response: Strike.Response) -> Strike.Response:
        response.success, response.message = request.dry, request.seam.tool
        return response

    node.create_service(Strike, "/strike", strike, callback_group=group)
    client = node.create_client(Strike, "/strike", callback_group=group)
    assert client.wait_for_service(WAIT_S)
    answer = result_of(client.call_async(Strike.Request(dry=True, seam=Seam(tool="mag"))))
    assert (answer.success, answer.message) == (True, "mag")

    told: list[float] = []

    def weld(goal: Any) -> Weld.Result:
        def tell() -> list[float]:
            """Again, because feedback is lost until its two ends have found each other."""
            goal.publish_feedback(Weld.Feedback(done=0.5))
            return told

        holds_within(tell, WAIT_S, poll_s=0.05)
        goal.succeed()
        return Weld.Result(length=goal.request.seam.offset[0])

    server = ActionServer(node, Weld, "/weld", weld, callback_group=group)
    asking = ActionClient(node, Weld, "/weld", callback_group=group)
    assert asking.wait_for_server(WAIT_S)
    goal = result_of(
        asking.send_goal_async(
            Weld.Goal(seam=Seam(offset=[1.5, 2.0, 3.0])),
            feedback_callback=lambda message: told.append(message.feedback.done),
        )
    )
    assert result_of(goal.get_result_async()).result.length == 1.5
    assert {*told} == {0.5}
    asking.destroy()
    server.destroy()


def test_what_a_stranger_sends_is_dropped_and_the_next_message_comes(node: Node) -> None:
    from weld_msgs.msg import Path

    rng = random.Random(5)
    got: list[Path] = []
    node.create_subscription(Path, "/odd", got.append, 100)
    publisher = node.create_publisher(Path, "/odd", 100)
    wait_until(lambda: publisher.get_subscription_count() == 1, WAIT_S)
    good = filled(Path, rng)
    data = serialize_message(good)
    for _ in range(50):
        publisher.publish(data[:4] + bytes(rng.randrange(256) for _ in range(len(data) // 3)))
    publisher.publish(good)
    wait_until(lambda: bool(got) and got[-1] == good, WAIT_S)


@pytest.fixture
def link(node: Node) -> Iterator[RosLink]:
    """The node of a command, beside the other one."""
    made = RosLink("roboneuron_asks")
    made.open()
    yield made
    made.close()


def until_discovered(link: RosLink, *topics: str) -> NodeGraph:
    """The graph, once its topics, whose node they are and the node's services are there."""
    graph = NodeGraph(link)

    def owners(topic: str) -> set[str]:
        return {endpoint.node_name for endpoint in graph.endpoints(topic)}

    wait_until(lambda: graph.topics().keys() >= set(topics), WAIT_S)
    # DDS discovers an endpoint before ROS tells the name of its node
    wait_until(lambda: all(owners(topic) == {"welder"} for topic in topics), WAIT_S)
    wait_until(lambda: "/welder/get_type_description" in graph.services(), WAIT_S)
    return graph


def test_a_node_gives_the_definition_of_what_it_publishes(
    node: Node,
    link: RosLink,
    store: DefinitionStore,
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from weld_msgs.msg import Seam
    from weld_msgs.srv import Strike

    node.create_publisher(Seam, "/seam", 10)
    node.create_service(Strike, "/strike", lambda request, response: response)
    monkeypatch.setenv(PREFIXES, sys.prefix)  # another user has another store
    empty = DefinitionStore(tmp_path / "empty")
    found = ask_nodes(until_discovered(link, "/seam"), empty)
    assert SEAM in found.texts, found.refused
    assert found.texts[SEAM].text == store.text(SEAM)
    assert found.texts[SEAM].hashes[str(SEAM)] == hashes_here(store, SEAM)[str(SEAM)]
    assert not ask_nodes(NodeGraph(link), store).texts, "all of it is known"
