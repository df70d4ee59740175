"""Contract cases of this package's sources; loaded by the contract kit only."""

from __future__ import annotations

import array
import atexit
import shutil
import tempfile
from pathlib import Path

from rn_perception_camera.plugin import roboneuron_perceptions
from rn_testing.cases import PerceptionCase
from rn_testing.fakes import MemoryTopics, gantry_profile, gradient_image
from roboneuron import PerceptionSpec

_NS_PER_S = 1_000_000_000


def _spec(name: str) -> PerceptionSpec:
    return next(spec for spec in roboneuron_perceptions() if spec.name == name)


def _feed(source: object, topics: MemoryTopics) -> None:
    """Publish an image as the driver of the front camera."""
    from sensor_msgs.msg import Image  # heavy

    sec, nanosec = divmod(topics.now_ns(), _NS_PER_S)
    pixels = gradient_image(64, 48)
    message = Image(
        width=64, height=48, step=192, encoding="rgb8", data=array.array("B", pixels.tobytes())
    )
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    message.header.frame_id = "front_optical"
    topics.deliver("/driver/image_raw", message)


def ros_case() -> PerceptionCase:
    """Case of the fake robot's front camera, whose driver publishes when the kit requests it."""
    return PerceptionCase(
        spec=_spec("ros-camera"),
        options={"cameras": {"front": {"topic": "/driver/image_raw"}}},
        cameras=lambda: gantry_profile().cameras[:1],
        feed=_feed,
    )


def video_case() -> PerceptionCase:
    """Case of the fake robot's front camera, from a short video in a temporary directory that lasts
    as long as the process.
    """
    import cv2  # heavy

    directory = Path(tempfile.mkdtemp(prefix="roboneuron-video-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    path = directory / "gradient.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    for shade in range(8):
        writer.write(gradient_image(64, 48, 32 * shade)[:, :, ::-1])
    writer.release()
    return PerceptionCase(
        spec=_spec("video-camera"),
        options={"cameras": {"front": {"path": str(path), "loop": True}}},
        cameras=lambda: gantry_profile().cameras[:1],
    )
