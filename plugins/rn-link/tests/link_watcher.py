"""`link_watcher.py NAME FOLDER [NAMESPACE]`: access to a served robot from another machine.

It counts the joint states and images of the discovered robot, or of that namespace, and writes
FOLDER/NAME.json. While FOLDER/NAME.act exists it publishes actions that raise the hand.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from rn_link.environment import join_link
from rn_link.keeper import keep_link
from roboneuron.command import environment

LIFT_M = 0.004
"""Motion of each action; 10 actions a second."""


def main(name: str, folder: Path, namespace: str = "") -> None:
    """Observe until killed."""
    join_link()
    environment.prepare_environment(folder)
    import rclpy
    from sensor_msgs.msg import Image, JointState
    from std_msgs.msg import Float64MultiArray

    from roboneuron.ros.messages import to_action_message

    rclpy.init()
    keep_link()
    node = rclpy.create_node(f"watcher_{name}")
    seen = {"joint_states": 0, "images": 0}
    facts: dict[str, object] = {"positions": [], "nodes": [], "namespace": ""}
    subscriptions: dict[str, object] = {}

    def hear_joints(message: JointState) -> None:
        seen["joint_states"] += 1
        facts["positions"] = list(message.position)

    def hear_image(_: Image) -> None:
        seen["images"] += 1

    def look() -> None:
        for topic, types in node.get_topic_names_and_types():
            if topic.endswith("/joint_states") and "sensor_msgs/msg/JointState" in types:
                facts["namespace"] = topic.removesuffix("/joint_states")
                if topic not in subscriptions:
                    made = node.create_subscription(JointState, topic, hear_joints, 1)
                    subscriptions[topic] = made
            if topic.endswith("/image") and topic not in subscriptions:
                subscriptions[topic] = node.create_subscription(Image, topic, hear_image, 1)
        facts["nodes"] = [
            f"{place.rstrip('/')}/{one}" for one, place in node.get_node_names_and_namespaces()
        ]

    publishers: dict[str, object] = {}

    def act() -> None:
        place = namespace or str(facts["namespace"])
        if place and (folder / f"{name}.act").exists():
            if not publishers:
                publishers[""] = node.create_publisher(Float64MultiArray, f"{place}/action", 1)
            row = np.array([0.0, 0.0, LIFT_M, 0.0, 0.0, 0.0, 1.0])
            publishers[""].publish(to_action_message(row))  # type: ignore[attr-defined]

    def report() -> None:
        fresh = folder / f".{name}.new"
        fresh.write_text(json.dumps(seen | facts), encoding="utf-8")
        fresh.replace(folder / f"{name}.json")

    for period_s, step in ((0.5, look), (0.1, act), (0.1, report)):
        node.create_timer(period_s, step)
    while True:
        rclpy.spin_once(node, timeout_sec=0.5)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
