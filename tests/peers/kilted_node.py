"""Nodes of ROS 2 Kilted, without RoboNeuron: the endpoints of every peer of these tests, and a
managed node.

Run it in a shell with Kilted and the workspace of `make test-sourced` sourced; it ends with its
standard input.
"""

from __future__ import annotations

import sys
import threading
import zlib

import rclpy
from own_msgs.msg import Seam
from own_msgs.srv import Strike
from rclpy.action import ActionServer
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String, UInt8MultiArray
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci


def serve(node: Node) -> ActionServer:
    """Repeat texts, send and measure a megabyte, answer the switch service, count."""
    last = {"heard": "", "measured": ""}
    repeated = {name: node.create_publisher(String, name, 10) for name in last}
    large = node.create_publisher(UInt8MultiArray, "large", 1)

    def measure(message: UInt8MultiArray) -> None:
        data = bytes(message.data)
        last["measured"] = f"{len(data)} {zlib.crc32(data)}"

    def hear(message: String) -> None:
        last["heard"] = f"heard {message.data}"

    def repeat() -> None:
        large.publish(megabyte)
        for name, text in last.items():
            repeated[name].publish(String(data=text))

    def switch(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = request.data, "switched"
        return response

    def count(goal: object) -> Fibonacci.Result:
        goal.publish_feedback(Fibonacci.Feedback(sequence=[0, 1]))
        goal.succeed()
        return Fibonacci.Result(sequence=[0, 1, 1, 2, 3][: goal.request.order])

    megabyte = UInt8MultiArray(data=bytes(range(256)) * 4096)
    node.create_subscription(String, "say", hear, 10)
    node.create_subscription(UInt8MultiArray, "measure", measure, 1)
    node.create_timer(0.2, repeat)
    node.create_service(SetBool, "switch", switch)
    return ActionServer(node, Fibonacci, "count", count)


def misfit(node: Node, viewer: Node) -> None:
    """An image with an incompatible viewer, and types with conflicting definitions."""
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    blurred = node.create_publisher(String, "blurred", best_effort)
    node.create_timer(0.1, lambda: blurred.publish(String(data="blurred")))
    viewer.create_subscription(String, "blurred", lambda message: None, 1)
    node.create_subscription(Seam, "seam", lambda message: None, 1)
    node.create_service(Strike, "strike", lambda request, response: response)


def main() -> None:
    """Spin until standard input ends."""
    rclpy.init()
    nodes = [Node("peer", namespace="fr3"), Node("viewer", namespace="fr3")]
    counting = serve(nodes[0])
    misfit(*nodes)
    executor = SingleThreadedExecutor()
    for node in [*nodes, LifecycleNode("managed", namespace="fr3")]:
        executor.add_node(node)
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    print("there", flush=True)
    try:
        executor.spin()
    except ExternalShutdownException:
        counting.destroy()


def _end_with_stdin() -> None:
    sys.stdin.read()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
