"""One end of a two-process round trip; started by the ROS tests, not a test file.

- `serve`: subscribes to every message type, offers every service and action; prints one JSON line
  per thing received.
- `send`: publishes, calls and sends goals with values drawn from the seed; prints one JSON line per
  answer received.

Both derive everything at run time and share nothing but names and
the seed.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

import rclpy
from interface_values import ValueGenerator, parts_of
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from rn_testing.waiting import wait_until
from roboneuron.tools.ros.interfaces import LOSSLESS, MessageInterface, load_interface

QOS = QoSProfile(depth=10)
WIRE = os.dup(1)
os.dup2(2, 1)  # Fast DDS warns on standard output


def write_line(value: dict[str, Any]) -> None:
    with open(WIRE, "w", encoding="utf-8", closefd=False) as wire:
        wire.write(json.dumps(value) + "\n")


def topic(name: str) -> str:
    return "rt/" + name.replace("/", "_").lower()


def report(name: str, part: str, message: Any, interface: MessageInterface) -> None:
    write_line({"name": name, "part": part, "value": interface.decode(message, LOSSLESS)})


def make(part: MessageInterface, seed: int) -> Any:
    return part.encode(ValueGenerator(seed).value(part.message), now_ns=seed)


def serve(node: Node, names: list[str], seed: int) -> None:
    for name in names:
        interface, parts = load_interface(name), parts_of(name)
        if interface.kind == "msg":
            node.create_subscription(
                interface.ros_type,
                topic(name),
                lambda m, n=name, p=parts: report(n, "msg", m, p[0]),
                QOS,
            )
        elif interface.kind == "srv":
            node.create_service(
                interface.ros_type, topic(name), lambda q, r, n=name, p=parts: answer(n, q, p, seed)
            )
        else:
            ActionServer(
                node,
                interface.ros_type,
                topic(name),
                lambda g, n=name, p=parts: execute(node, n, g, p, seed),
            )


def answer(name: str, request: Any, parts: Any, seed: int) -> Any:
    report(name, "request", request, parts[0])
    return make(parts[1], seed)


def execute(node: Node, name: str, goal: Any, parts: Any, seed: int) -> Any:
    report(name, "goal", goal.request, parts[0])
    # the client sees the server before the server sees the client's subscription, and what is
    # published until then is lost
    wait_until(lambda: node.count_subscribers(f"{topic(name)}/_action/feedback") > 0)
    goal.publish_feedback(make(parts[2], seed))
    goal.succeed()
    return make(parts[1], seed)


def send(
    node: Node, names: list[str], seed: int, spin: Callable[[Callable[[], bool]], None]
) -> None:
    for name in names:
        interface, parts = load_interface(name), parts_of(name)
        if interface.kind == "msg":
            publisher = node.create_publisher(interface.ros_type, topic(name), QOS)
            spin(lambda p=publisher: p.get_subscription_count() > 0)
            publisher.publish(make(parts[0], seed))
        elif interface.kind == "srv":
            client = node.create_client(interface.ros_type, topic(name))
            spin(client.service_is_ready)
            future = client.call_async(make(parts[0], seed))
            spin(future.done)
            report(name, "response", future.result(), parts[1])
        else:
            send_goal(node, name, interface, parts, seed, spin)


def send_goal(node: Node, name: str, interface: Any, parts: Any, seed: int, spin: Any) -> None:
    client = ActionClient(node, interface.ros_type, topic(name))
    spin(client.server_is_ready)
    seen: list[Any] = []
    accepted = client.send_goal_async(
        make(parts[0], seed), feedback_callback=lambda f: seen.append(f.feedback)
    )
    spin(accepted.done)
    result = accepted.result().get_result_async()
    spin(lambda: result.done() and bool(seen))
    report(name, "result", result.result().result, parts[1])
    report(name, "feedback", seen[0], parts[2])


def main() -> None:
    role, seed, names = sys.argv[1], int(sys.argv[2]), json.loads(sys.stdin.readline())
    rclpy.init()
    node = rclpy.create_node(f"round_trip_{role}")
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin(done: Callable[[], bool], timeout_s: float = 30.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not done():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{role} waited for {timeout_s} s")
            executor.spin_once(timeout_sec=0.005)

    if role == "serve":
        serve(node, names, seed)
        write_line({"ready": len(names)})
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()
    else:
        send(node, names, seed, spin)
        write_line({"sent": len(names)})
        sys.stdin.readline()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
