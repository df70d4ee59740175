"""One camera image for the agent: subscribed on demand, decoded, encoded as a file."""

from __future__ import annotations

import io
import time
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from roboneuron.contract import Frame
from roboneuron.errors import ConfigurationError, InvalidInputError, NotReadyError
from roboneuron.plugins.specs import RobotSpec
from roboneuron.ros.messages import frame_from_message
from roboneuron.server.host import Host
from roboneuron.server.tool import Arguments, CallContext, Picture, Reply, Result, Tool
from roboneuron.sight.inputs import image_topic, why_no_image

if TYPE_CHECKING:
    from sensor_msgs.msg import Image

IMAGE_TYPE = "sensor_msgs/msg/Image"
Format = Literal["jpeg", "png"]
_JPEG_QUALITY = 90


class GetCameraImage(Arguments):
    """Arguments of get_camera_image."""

    camera: str | None = Field(default=None, description="The first one if omitted.")
    format: Format = Field(default="jpeg", description="jpeg is small, png is exact.")
    timeout_s: float = Field(default=5.0, gt=0, le=60, description="[s]")


class CameraImage(Result):
    """Properties of the accompanying image."""

    camera: str
    width_px: int
    height_px: int
    stamp_ns: int = Field(description="capture time, ROS clock")
    age_ms: float = Field(description="time from its capture to this answer")
    frame_id: str = Field(description="the camera's optical frame")


def camera_tool(host: Host) -> Tool[GetCameraImage]:
    """get_camera_image."""

    async def get_camera_image(arguments: GetCameraImage, context: CallContext) -> Reply:
        return await context.run(lambda _: _answer(host, arguments))

    return Tool(
        name="get_camera_image",
        title="Look through a camera",
        description="The next image of a camera. Needs start_perception.",
        arguments=GetCameraImage,
        result=CameraImage,
        handler=get_camera_image,
        read_only=True,
        idempotent=True,
        open_world=True,
        choices={"camera": host.loop.camera_roles},
    )


def _answer(host: Host, arguments: GetCameraImage) -> Reply:
    camera = arguments.camera or next(iter(host.loop.camera_roles()), "")
    frame = read_frame(host, camera, arguments.timeout_s)
    height, width = frame.image.shape[:2]
    facts = CameraImage(
        camera=camera,
        width_px=width,
        height_px=height,
        stamp_ns=frame.stamp_ns,
        age_ms=round((time.time_ns() - frame.stamp_ns) / 1e6, 1),
        frame_id=frame.frame_id,
    )
    return Reply(result=facts, pictures=(encode(frame, arguments.format),))


def read_frame(host: Host, camera: str, timeout_s: float) -> Frame:
    """Return the next image of the camera; blocks for at most `timeout_s`.

    Raises:
        ConfigurationError: the topic has another type.
        InvalidInputError: the robot has no such camera, or the image is damaged or of an unknown
            encoding.
        NotReadyError: there is no publisher, or no image arrived in time.
    """
    check_camera(host, camera)
    graph = host.graph  # first: two threads must not import rclpy at the same time
    from sensor_msgs.msg import Image  # heavy

    topic = image_topic(host.config.namespace, camera)
    changes, deadline_s = host.modules.changes, time.monotonic() + timeout_s
    publishers = changes.wait_for(lambda: graph.publishers(topic) or None, timeout_s)
    if not publishers:
        raise NotReadyError(
            f"Nobody publishes images of camera {camera!r} on {topic}.", hint=why_no_image(host)
        )
    foreign = [info.topic_type for info in publishers if info.topic_type != IMAGE_TYPE]
    if foreign:
        raise ConfigurationError(f"Topic {topic} carries {foreign[0]}, expected {IMAGE_TYPE}.")
    received: list[Image] = []

    def take(message: Image) -> None:
        received.append(message)
        changes.notify()

    unsubscribe = host.subscribe(Image, topic, take)
    try:
        arrived = changes.wait_for(lambda: bool(received), max(0.0, deadline_s - time.monotonic()))
    finally:
        unsubscribe()
    if not arrived:
        raise NotReadyError(
            f"Camera {camera!r} delivered no image on {topic} within {timeout_s:g} s.",
            hint=why_no_image(host),
        )
    return frame_from_message(received[0], camera)


def encode(frame: Frame, form: Format) -> Picture:
    """Encode the frame as a PNG (exact) or JPEG (small) file."""
    from PIL import Image as Pillow  # heavy

    buffer = io.BytesIO()
    picture = Pillow.fromarray(frame.image)
    if form == "png":
        picture.save(buffer, "PNG", compress_level=3)
    else:
        picture.save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return Picture(data=buffer.getvalue(), mime_type=f"image/{form}")


def check_camera(host: Host, camera: str) -> None:
    """Raise InvalidInputError, with the choices, if the robot has no such camera."""
    spec = host.registry.get(RobotSpec, host.config.robot.name)
    known = [camera.name for camera in spec.cameras]
    if camera not in known:
        raise InvalidInputError(
            f"Robot {spec.name!r} has no camera {camera!r}.",
            hint=f"Choose one of: {', '.join(known)}." if known else "It has none.",
            path="camera",
        )
