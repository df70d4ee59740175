"""One camera image for the agent: subscribed on demand, decoded, encoded as a file."""

from __future__ import annotations

import io
import time
from typing import TYPE_CHECKING, Literal

from roboneuron.contract.observation import Frame
from roboneuron.errors import ConfigurationError, InvalidInputError, NotReadyError
from roboneuron.ros.topics import camera_image
from roboneuron.server.tool import Picture
from roboneuron.supervisor.changes import Changes

if TYPE_CHECKING:
    from sensor_msgs.msg import Image

    from roboneuron.ros.link import RosLink

IMAGE_TYPE = "sensor_msgs/msg/Image"
Format = Literal["jpeg", "png"]
_JPEG_QUALITY = 90


def read_frame(link: RosLink, namespace: str, camera: str, timeout_s: float, *, hint: str) -> Frame:
    """The next image that the camera publishes; blocks for at most `timeout_s`.

    Raises:
        ConfigurationError: the topic carries another type.
        InvalidInputError: the image is damaged or of an unknown encoding.
        NotReadyError: nobody publishes, or nothing came in time; `hint` says what to do.
    """
    from sensor_msgs.msg import Image  # heavy

    from roboneuron.ros.messages import frame_from_message
    from roboneuron.ros.qos import sensor_subscription

    topic = f"/{namespace}/{camera_image(camera)}"
    changes, deadline_s = Changes(), time.monotonic() + timeout_s
    types = changes.wait_for(lambda: link.publisher_types(topic) or None, timeout_s)
    if not types:
        raise NotReadyError(f"Nobody publishes images of camera {camera!r} on {topic}.", hint=hint)
    foreign = [name for name in types if name != IMAGE_TYPE]
    if foreign:
        raise ConfigurationError(f"Topic {topic} carries {foreign[0]}, expected {IMAGE_TYPE}.")
    received: list[Image] = []

    def take(message: Image) -> None:
        received.append(message)
        changes.notify()

    unsubscribe = link.subscribe(Image, topic, take, sensor_subscription(link.are_publishers_reliable(topic)))
    try:
        arrived = changes.wait_for(lambda: bool(received), max(0.0, deadline_s - time.monotonic()))
    finally:
        unsubscribe()
    if not arrived:
        raise NotReadyError(f"Camera {camera!r} delivered no image on {topic} within {timeout_s:g} s.", hint=hint)
    return frame_from_message(received[0], camera)


def encode(frame: Frame, form: Format) -> Picture:
    """The frame as a PNG (exact) or JPEG (small) file."""
    from PIL import Image as Pillow  # heavy

    buffer = io.BytesIO()
    picture = Pillow.fromarray(frame.image)
    if form == "png":
        picture.save(buffer, "PNG", compress_level=3)
    else:
        picture.save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return Picture(data=buffer.getvalue(), mime_type=f"image/{form}")


def check_camera(camera: str, known: list[str], robot: str) -> None:
    """Raises InvalidInputError, with the choices, when the robot has no such camera."""
    if camera not in known:
        raise InvalidInputError(
            f"Robot {robot!r} has no camera {camera!r}.",
            hint=f"Choose one of: {', '.join(known)}." if known else "It has none.",
            path="camera",
        )
