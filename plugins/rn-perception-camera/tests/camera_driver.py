"""A camera driver for one test: `python camera_driver.py best_effort|reliable`; ends when its
standard input does.

Publishes /usb/image_raw (bgr8, 64x48, blue and the stamp's last digits count images),
/usb/camera_info and /usb/depth (16UC1, 500 mm and the count) at 50 Hz, and the same image as a PNG
on /usb/image_raw/compressed.
"""

from __future__ import annotations

import array
import io
import select
import sys
import tempfile
from pathlib import Path

import numpy as np

from roboneuron.ros.environment import prepare_environment


def main(reliability: str) -> None:
    """Publish until standard input closes."""
    prepare_environment(Path(tempfile.gettempdir()))
    import rclpy
    from PIL import Image as Pillow
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

    rclpy.init()
    node = rclpy.create_node("usb_camera")
    qos = QoSProfile(
        depth=5,
        reliability=ReliabilityPolicy.RELIABLE
        if reliability == "reliable"
        else ReliabilityPolicy.BEST_EFFORT,
    )
    images = node.create_publisher(Image, "/usb/image_raw", qos)
    files = node.create_publisher(CompressedImage, "/usb/image_raw/compressed", qos)
    infos = node.create_publisher(CameraInfo, "/usb/camera_info", qos)
    depths = node.create_publisher(Image, "/usb/depth", qos)
    count = 0
    while not select.select([sys.stdin], [], [], 0.02)[0]:
        count = (count + 1) % 256
        stamp = node.get_clock().now().to_msg()
        stamp.nanosec = stamp.nanosec // 1000 * 1000 + count
        bgr = np.empty((48, 64, 3), dtype=np.uint8)
        bgr[:] = (count, 100, 200)
        image = Image(
            width=64, height=48, step=192, encoding="bgr8", data=array.array("B", bgr.tobytes())
        )
        depth_mm = np.full((48, 64), 500 + count, dtype="<u2")
        depth = Image(
            width=64,
            height=48,
            step=128,
            encoding="16UC1",
            data=array.array("B", depth_mm.tobytes()),
        )
        buffer = io.BytesIO()
        Pillow.fromarray(np.ascontiguousarray(bgr[:, :, ::-1])).save(buffer, "png")
        file = CompressedImage(
            format="bgr8; png compressed bgr8", data=array.array("B", buffer.getvalue())
        )
        info = CameraInfo(width=64, height=48, distortion_model="plumb_bob", d=[0.0] * 5)
        info.k = [50.0, 0.0, 30.0, 0.0, 50.0, 20.0, 0.0, 0.0, 1.0]
        for message, publisher in ((info, infos), (image, images), (depth, depths), (file, files)):
            message.header.stamp, message.header.frame_id = stamp, "usb_optical"
            publisher.publish(message)
    node.destroy_node()
    rclpy.shutdown()  # otherwise its publishers seem to live for 20 s


if __name__ == "__main__":
    main(sys.argv[1])
