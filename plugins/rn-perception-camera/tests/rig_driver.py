"""A driver of several cameras for one test, which publishes one message of a learnt type for all of
them; ends when its standard input does.

Publishes rig_msgs/msg/Views on /rig/views at 50 Hz: two raw views and a PNG, 64x48; blue and the
stamp's last digits count.
"""

from __future__ import annotations

import array
import io
import select
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from rn_interfaces.finder import install
from roboneuron.ros.environment import prepare_environment


def main() -> None:
    """Publish until standard input closes."""
    prepare_environment(Path(tempfile.gettempdir()))
    install()
    import rclpy
    from PIL import Image as Pillow
    from rig_msgs.msg import View, Views
    from sensor_msgs.msg import CompressedImage, Image

    rclpy.init()
    node = rclpy.create_node("rig")
    publisher = node.create_publisher(Views, "/rig/views", 5)
    count = 0

    def stamped(message: Any) -> Any:
        message.header.stamp, message.header.frame_id = stamp, "rig_optical"
        return message

    while not select.select([sys.stdin], [], [], 0.02)[0]:
        count = (count + 1) % 256
        stamp = node.get_clock().now().to_msg()
        stamp.nanosec = stamp.nanosec // 1000 * 1000 + count
        views = []
        for name, red in (("left", 7), ("right", 9)):
            pixels = np.full((48, 64, 3), (red, 100, count), dtype=np.uint8)
            data = array.array("B", pixels.tobytes())
            picture = Image(width=64, height=48, step=192, encoding="rgb8", data=data)
            views.append(View(name=name, picture=stamped(picture)))
        buffer = io.BytesIO()
        Pillow.fromarray(np.full((48, 64, 3), (200, 100, count), dtype=np.uint8)).save(
            buffer, "png"
        )
        file = CompressedImage(format="png", data=array.array("B", buffer.getvalue()))
        publisher.publish(Views(views=views, overview=stamped(file), gain=1.5))
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
