"""Every camera with a picture of each: configured ones, V4L2 devices, image topics."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rn_cameras.live import opened
from rn_perception_camera.capture import open_capture
from rn_perception_camera.devices import VideoDevice, node_of, video_devices
from rn_perception_camera.options import VideoCameraOptions
from roboneuron import (
    CameraProfile,
    InvalidInputError,
    MissingDependencyError,
    NotReadyError,
    RoboNeuronError,
    depth_from_message,
    frame_from_compressed,
    image_from_message,
)
from roboneuron.command import RosLink
from roboneuron.feature import Config, Registry, load_profile

if TYPE_CHECKING:
    from sensor_msgs.msg import CompressedImage
    from sensor_msgs.msg import Image as ImageMessage

U8 = NDArray[np.uint8]

DISCOVERY_S = 3.0
"""The other nodes announce themselves within this time."""
TOPIC_S = 3.0
"""Longest wait for a message of an image topic."""
_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_DEPTH = ("16UC1", "32FC1")
_WARM_UP = 5
"""Pictures of a device that are dropped: the first ones are dark until the exposure has adapted."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ListedCamera:
    """A camera.

    Attributes:
        name: of a configured camera, of a device as the option `device` takes it, or of a topic.
        kind: "configured", "device" or "topic".
        about: what else is known: card, type, source.
        size: width and height of its picture [px]; None without one.
        problem: why there is no picture; empty if there is one.
        picture: name of the file; empty without one.
    """

    name: str
    kind: str
    about: str
    size: tuple[int, int] | None = None
    problem: str = ""
    picture: str = ""


def look(kind: str, name: str, about: str, folder: Path, take: Callable[[], U8]) -> ListedCamera:
    """List a camera with the picture that `take` returns; its failure is this camera's problem."""
    try:
        picture = take()
    except RoboNeuronError as error:
        return ListedCamera(name=name, kind=kind, about=about, problem=str(error))
    except Exception as error:  # a driver's or decoder's own failure concerns this camera alone
        return ListedCamera(name=name, kind=kind, about=about, problem=repr(error))
    words = "".join(letter if letter.isalnum() else "-" for letter in name).strip("-")
    path = folder / f"{kind}-{words}.png"
    Image.fromarray(picture).save(path)
    size = (picture.shape[1], picture.shape[0])
    return ListedCamera(name=name, kind=kind, about=about, size=size, picture=path.name)


def configured_cameras(
    config: Config, registry: Registry, link: RosLink, folder: Path
) -> Iterator[ListedCamera]:
    """The cameras of the configuration, as perception would serve them.

    Raises:
        RoboNeuronError: the robot's plugin cannot be used.
    """
    if config.perception is None:
        return
    source, chosen = config.perception.source, config.perception.cameras
    for camera in load_profile(registry, config.robot).cameras:
        if chosen and camera.name not in chosen:
            continue

        def take(camera: CameraProfile = camera) -> U8:
            with opened(config, registry, link, camera, is_raw=False) as frame:
                return frame().image

        yield look("configured", camera.name, source, folder, take)


def device_cameras(folder: Path, configs: Sequence[Config]) -> Iterator[ListedCamera]:
    """The V4L2 devices; further nodes of a camera that has given a picture are left out if they
    give none.

    Args:
        folder: for the pictures.
        configs: tell which of them are configured.
    """
    seen: set[str] = set()
    names = {node: name for config in configs for node, name in _configured_nodes(config).items()}
    for device in video_devices():
        about = f"{device.node}, {device.card}"
        if device.node in names:
            about += f", configured as {names[device.node]}"

        def take(device: VideoDevice = device) -> U8:
            return _grab(device)

        found = look("device", device.name, about, folder, take)
        if found.problem and device.unit in seen:
            continue
        if not found.problem:
            seen.add(device.unit)
        yield found


def _configured_nodes(config: Config) -> dict[str, str]:
    """Configured cameras by the node of their device."""
    tables = config.options("video-camera").get("cameras")
    links = {link: one.node for one in video_devices() for link in one.links}
    nodes = {}
    for name, table in tables.items() if isinstance(tables, dict) else ():
        device = table.get("device") if isinstance(table, dict) else None
        with suppress(RoboNeuronError):
            node = node_of(device) if isinstance(device, int | str) else ""
            node = f"/dev/video{node}" if isinstance(node, int) else node
            nodes[links.get(node, node)] = str(name)
    return nodes


def _grab(device: VideoDevice) -> U8:
    try:
        capture, _ = open_capture(VideoCameraOptions(device=device.node))
    except ImportError as error:
        raise MissingDependencyError(
            "OpenCV is not installed.", hint="pip install opencv-python-headless"
        ) from error
    try:
        for _ in range(_WARM_UP):
            if not capture.grab():
                raise NotReadyError("It opens, but gives no pictures.")
        is_whole, bgr = capture.retrieve()
    finally:
        capture.release()
    if not is_whole:
        raise NotReadyError("Its picture cannot be decoded.")
    return np.ascontiguousarray(bgr[:, :, ::-1])


def topic_cameras(link: RosLink, folder: Path) -> Iterator[ListedCamera]:
    """The image topics that somebody publishes, depth as grey; of a topic's compressed variants
    only those that stand alone.
    """
    deadline_s = time.monotonic() + DISCOVERY_S
    while (left_s := deadline_s - time.monotonic()) > 0:
        time.sleep(min(0.1, left_s))
    node = link.node
    types = {
        name: next((kind for kind in kinds if kind in _TYPES), "")
        for name, kinds in node.get_topic_names_and_types()
        if node.count_publishers(name)
    }
    topics = sorted(name for name, kind in types.items() if kind)
    for topic in topics:
        if topic.rpartition("/")[0] in topics and types[topic] == _TYPES[1]:
            continue

        def take(topic: str = topic) -> U8:
            return _receive(link, topic, is_compressed=types[topic] == _TYPES[1])

        yield look("topic", topic, types[topic], folder, take)


def _receive(link: RosLink, topic: str, *, is_compressed: bool) -> U8:
    """A picture of a topic. Raises NotReadyError, InvalidInputError."""
    from sensor_msgs.msg import CompressedImage, Image  # heavy

    came, messages = threading.Event(), list[Any]()

    def receive(message: object) -> None:
        messages[:] = [message]
        came.set()

    kind: type = CompressedImage if is_compressed else Image
    end = link.follow(kind, topic, receive, latched=False)
    try:
        if not came.wait(TOPIC_S):
            raise NotReadyError(f"It has a publisher, but nothing came within {TOPIC_S:g} s.")
    finally:
        end()
    return to_picture(messages[0])


def to_picture(message: ImageMessage | CompressedImage) -> U8:
    """uint8 (H, W, 3) of a message; depth as grey, near light. Raises InvalidInputError."""
    if hasattr(message, "format"):
        compressed = cast("CompressedImage", message)
        return frame_from_compressed(compressed.data, compressed.format)
    image = cast("ImageMessage", message)
    if image.encoding not in _DEPTH:
        return image_from_message(image)
    depth_m = depth_from_message(image)
    known = np.isfinite(depth_m) & (depth_m > 0)
    if not known.any():
        raise InvalidInputError("It shows no depth at any pixel.")
    near_m, far_m = np.percentile(depth_m[known], (1, 99))
    away = (depth_m - near_m) / max(far_m - near_m, 1e-6)
    grey = np.where(known, 255 - 215 * np.clip(np.nan_to_num(away), 0, 1), 0).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)
