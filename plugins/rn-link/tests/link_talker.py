"""`link_talker.py NAME FOLDER [--images]`: publishes its name on `/talk` 20 times a second, counts
the received names, and writes FOLDER/NAME.json; with --images it also publishes 30 images a second.
"""

from __future__ import annotations

import array
import json
import sys
import time
from pathlib import Path

from rn_link.environment import join_link
from rn_link.keeper import keep_link
from roboneuron.command import environment

SIDE = 224


def main(name: str, folder: Path, *options: str) -> None:
    """Publish until killed."""
    join_link()
    environment.prepare_environment(folder)
    import rclpy
    from sensor_msgs.msg import Image
    from std_msgs.msg import String

    rclpy.init()
    keep_link()
    node = rclpy.create_node(f"talker_{name.replace('-', '_')}")
    heard: dict[str, int] = {}
    gaps_s: dict[str, float] = {}
    last_s: dict[str, float] = {}

    def hear(said: str) -> None:
        now_s = time.monotonic()
        gaps_s[said] = max(gaps_s.get(said, 0.0), now_s - last_s.get(said, now_s))
        last_s[said] = now_s
        heard[said] = heard.get(said, 0) + 1

    node.create_subscription(String, "/talk", lambda message: hear(message.data), 10)
    node.create_subscription(Image, "/image", lambda image: hear(image.header.frame_id), 1)
    talk = node.create_publisher(String, "/talk", 10)
    images = node.create_publisher(Image, "/image", 1)
    picture = Image(height=SIDE, width=SIDE, encoding="rgb8", step=3 * SIDE)
    picture.data = array.array("B", bytes(SIDE * SIDE * 3))
    picture.header.frame_id = f"{name}'s image"

    def report() -> None:
        fresh = folder / f".{name}.new"
        fresh.write_text(json.dumps({"heard": heard, "gaps_s": gaps_s}), encoding="utf-8")
        fresh.replace(folder / f"{name}.json")

    node.create_timer(0.05, lambda: talk.publish(String(data=name)))
    if "--images" in options:
        node.create_timer(1 / 30, lambda: images.publish(picture))
    node.create_timer(0.1, report)
    while True:
        rclpy.spin_once(node, timeout_sec=0.5)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
