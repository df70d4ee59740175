"""The floor of bench_loop.py: a bare rclpy node that answers every image with a
Float64MultiArray.
"""

from __future__ import annotations

import array
from typing import Any

from roboneuron.ros.environment import prepare_environment


def main() -> None:
    """Relay until SIGTERM."""
    prepare_environment()
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import Image
    from std_msgs.msg import Float64MultiArray

    rclpy.init()
    node = rclpy.create_node("relay", namespace="bench")
    publisher = node.create_publisher(Float64MultiArray, "action", QoSProfile(depth=1))

    def answer(message: Any) -> None:
        number = int.from_bytes(bytes(message.data[:4]), "little")
        publisher.publish(Float64MultiArray(data=array.array("d", [number, 0, 0, 0, 0, 0, 1])))

    node.create_subscription(Image, "camera/front/image", answer, QoSProfile(depth=1))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
