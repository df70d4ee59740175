"""A node that only uses the sourced ROS, without RoboNeuron: it records seams and serves strikes.

Run it in a shell with the workspace sourced; it ends with its standard input.
"""

from __future__ import annotations

import sys
import threading

import rclpy
from own_msgs.msg import Seam
from own_msgs.srv import Strike
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import String


def main() -> None:
    """Serve, and repeat the last received text on /fr3/heard."""
    rclpy.init()
    node = rclpy.create_node("own", namespace="fr3")
    heard = node.create_publisher(String, "heard", 1)
    last = [""]

    def hear(seam: Seam) -> None:
        last[0] = f"{seam.tool} {seam.offset.tolist()} {len(seam.picture)}"

    def strike(request: Strike.Request, response: Strike.Response) -> Strike.Response:
        response.success, response.message = True, request.seam.tool
        return response

    node.create_subscription(Seam, "seam", hear, 10)
    node.create_service(Strike, "strike", strike)
    node.create_timer(0.1, lambda: heard.publish(String(data=last[0])))
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    print("there", flush=True)
    try:
        rclpy.spin(node)
    except ExternalShutdownException:
        node.destroy_node()


def _end_with_stdin() -> None:
    sys.stdin.read()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
