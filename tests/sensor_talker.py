"""Publishes the topics of a robot with a detector: transforms, detections and its battery. It
prints the goals that it receives.

    python tests/sensor_talker.py NAMESPACE
"""

from __future__ import annotations

import sys
from contextlib import suppress

import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import BatteryState

from rn_interfaces.finder import install

install()
from tf2_msgs.msg import TFMessage  # noqa: E402  (known from here on)
from vision_msgs.msg import (  # noqa: E402
    Detection2D,
    Detection2DArray,
    Detection3D,
    Detection3DArray,
    ObjectHypothesisWithPose,
)

CAMERA = "camera"
PERIOD_S = 0.05


class SensorTalker(Node):
    """The frames are map, odom, base and camera; `stray` is in a separate tree."""

    def __init__(self, namespace: str) -> None:
        super().__init__("sensor_talker", namespace=namespace)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        # each of two nodes holds a transform
        self._kept = [self.create_publisher(TFMessage, "/tf_static", kept) for _ in range(2)]
        self._kept[0].publish(TFMessage(transforms=[self._transform("base", CAMERA, x=0.5)]))
        self._kept[1].publish(TFMessage(transforms=[self._transform("map", "odom", y=1.0)]))
        self._tf = self.create_publisher(TFMessage, "/tf", 10)
        self._flat = self.create_publisher(Detection2DArray, "seen_flat", 1)
        self._spatial = self.create_publisher(Detection3DArray, "seen", 1)
        self._battery = self.create_publisher(BatteryState, "battery", 1)
        self.create_subscription(PoseStamped, "goal", self._on_goal, 1)
        self.create_timer(PERIOD_S, self._tell)

    def _transform(
        self, parent: str, child: str, x: float = 0.0, y: float = 0.0, late_s: int = 0
    ) -> TransformStamped:
        made = TransformStamped(child_frame_id=child)
        made.header.frame_id = parent
        made.header.stamp = self.get_clock().now().to_msg()
        made.header.stamp.sec -= late_s
        made.transform.translation.x, made.transform.translation.y = x, y
        made.transform.rotation.w = 1.0
        return made

    def _tell(self) -> None:
        self._tf.publish(
            TFMessage(
                transforms=[
                    self._transform("odom", "base", x=2.0),
                    self._transform("rig", "stray"),
                    self._transform("map", "late", late_s=60),
                ]
            )
        )
        stamp = self.get_clock().now().to_msg()
        spatial, flat = Detection3DArray(), Detection2DArray()
        for message in (spatial, flat):
            message.header.frame_id, message.header.stamp = CAMERA, stamp
        for index in range(30):
            result = ObjectHypothesisWithPose()
            result.hypothesis.class_id = "cup" if index % 2 else "plate"
            result.hypothesis.score = index / 100.0
            thing = Detection3D(id=str(index), results=[result])
            thing.bbox.center.position.x = 0.1 * index
            thing.bbox.center.orientation.w = 1.0
            thing.bbox.size.z = 0.2
            spatial.detections.append(thing)
        box = Detection2D(results=[result])
        box.bbox.center.position.x, box.bbox.size_x = 320.0, 40.0
        flat.detections = [box]
        self._spatial.publish(spatial)
        self._flat.publish(flat)
        nothing = float("nan")
        battery = BatteryState(voltage=24.5, percentage=0.15, current=-1.5, temperature=nothing)
        battery.power_supply_status = BatteryState.POWER_SUPPLY_STATUS_DISCHARGING
        self._battery.publish(battery)

    def _on_goal(self, message: PoseStamped) -> None:
        place = message.pose.position
        print(message.header.frame_id, round(place.x, 3), round(place.y, 3), flush=True)


def main() -> None:
    """Run until SIGTERM."""
    rclpy.init()
    node = SensorTalker(sys.argv[1])
    print("talking", flush=True)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
