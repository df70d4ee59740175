"""Newest messages of the robot and its cameras, decoded; for tasks and for looking."""

from __future__ import annotations

import logging
import operator
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from roboneuron.contract import (
    CameraCalibration,
    CameraProfile,
    Frame,
    Pose,
    RobotProfile,
    pose_from_message,
    to_ns,
)
from roboneuron.contract.image import depth_from_message
from roboneuron.direct_path.fields import load_type
from roboneuron.errors import InvalidInputError, RoboNeuronError
from roboneuron.ros import messages
from roboneuron.server.host import Host
from roboneuron.supervisor.overload import overload

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseStamped
    from sensor_msgs.msg import CameraInfo, Image

__all__ = ["Inputs"]
"""Names that other distributions may use."""

log = logging.getLogger(__name__)
_AGE_S, _IMAGE_AGE_S = 0.5, 2.0
"""Maximum age of measurements, and of images."""
_KEPT = 3
"""Depths that wait for the image of their time: the two come on different topics."""


class Inputs:
    """Newest messages of topics, from their first use until `close`.

    Args:
        host: the server.
        age_factor: they may be so many times older than usual.
    """

    def __init__(self, host: Host, *, age_factor: float = 1.0) -> None:
        self._host = host
        self._age_factor = age_factor
        self._newest: dict[str, tuple[float, Any]] = {}
        self._ends: list[Callable[[], None]] = []
        self._depths: dict[str, deque[Image]] = {}
        self._decoded: dict[str, tuple[tuple[object, ...], Frame]] = {}

    def open(
        self, topic: str, type_name: str, then: Callable[[Any], None] = lambda _: None
    ) -> None:
        """Subscribe to a topic.

        Args:
            topic, type_name: such as "/fr3/ee_pose", "geometry_msgs/msg/PoseStamped".
            then: called with each message, on the thread of the ROS node.

        Raises:
            RoboNeuronError: an unknown type, or ROS cannot be joined.
        """
        _ = self._host.graph  # first: two threads must not import rclpy at the same time
        ros_type = load_type(type_name)

        def take(message: Any) -> None:
            self._newest[topic] = time.monotonic(), message
            then(message)

        self._ends.append(self._host.subscribe(ros_type, topic, take, latched=True))

    def open_camera(self, topic: str, *, with_depth: bool = False) -> None:
        """Subscribe to a camera's images and their intrinsics, and to their depth. Raises as
        `open`.
        """
        self.open(_info_topic(topic), "sensor_msgs/msg/CameraInfo")
        if with_depth:
            kept = self._depths.setdefault(topic, deque(maxlen=_KEPT))
            self.open(depth_topic(topic), "sensor_msgs/msg/Image", kept.append)
        self.open(topic, "sensor_msgs/msg/Image")

    def newest(self, topic: str, age_s: float = _AGE_S) -> Any:
        """The newest message, or None if it is older than `age_s`."""
        found = self._newest.get(topic)
        return found[1] if found is not None and self._is_new(found[0], age_s) else None

    def _is_new(self, since_s: float, age_s: float) -> bool:
        return time.monotonic() - since_s <= age_s * self._age_factor

    def last(self, topic: str) -> Any:
        """The newest message of any age; None before the first."""
        found = self._newest.get(topic)
        return None if found is None else found[1]

    def frame(
        self,
        topic: str,
        camera: str,
        profile: RobotProfile | None,
        since_s: float = -np.inf,
    ) -> Frame | None:
        """The newest image of a camera, with the calibration of the profile and the depth of the
        same time if it has come; None if it is too old, or came before `since_s`, monotonic [s].
        """
        message = self.newest(topic, _IMAGE_AGE_S)
        if message is None or self._newest[topic][0] < since_s:
            return None
        stamp_ns = to_ns(message.header.stamp)
        depths = list(self._depths.get(topic, ()))
        depth = next((one for one in depths if to_ns(one.header.stamp) == stamp_ns), None)
        parts = (message, self.last(_info_topic(topic)), depth)
        decoded = self._decoded.get(camera)
        if decoded is not None and all(map(operator.is_, decoded[0], parts)):
            return decoded[1]
        known = profile.camera(camera) if profile is not None else None
        try:
            frame = messages.frame_from_message(message, camera)
            if known is not None:
                frame = replace(frame, calibration=_calibration(known, frame, parts[1]))
        except InvalidInputError as error:
            log.warning("An image of %s cannot be used: %s", camera, error)
            return None
        if depth is not None:
            frame = _with_depth(frame, depth)
        self._decoded[camera] = (parts, frame)
        return frame

    def image_topic(self, camera: str) -> str:
        """Topic of the images of a camera of the robot."""
        return image_topic(self._host.config.namespace, camera)

    def pose_topic(self, arm: str = "") -> str:
        """Topic of the measured TCP pose, of the named arm if there are several."""
        return pose_topic(self._host.config.namespace, arm)

    def pose(self, arm: str = "") -> Pose | None:
        """The TCP pose of an arm whose topic is open; None if none is new, or it is damaged."""
        return pose_of(self.newest(self.pose_topic(arm)))

    def close(self) -> None:
        """Unsubscribe; idempotent."""
        while self._ends:
            with suppress(RoboNeuronError):
                self._ends.pop()()


def image_topic(namespace: str, camera: str) -> str:
    """Topic of the images of a camera."""
    return f"/{namespace}/camera/{camera}/image"


def _calibration(
    camera: CameraProfile, frame: Frame, info: CameraInfo | None
) -> CameraCalibration | None:
    """The mounting of the profile with the intrinsics that are published for pictures of this size;
    without them, those of the profile. Raises InvalidInputError.
    """
    height, width = frame.image.shape[:2]
    if camera.calibration is None or info is None or (info.width, info.height) != (width, height):
        return camera.calibration_at(width, height)
    return replace(camera.calibration, intrinsics=messages.intrinsics_from_camera_info(info))


def _info_topic(topic: str) -> str:
    return f"{topic.removesuffix('image')}camera_info"


def depth_topic(topic: str) -> str:
    """Topic of the depth of a camera's images."""
    return f"{topic.removesuffix('image')}depth"


def _with_depth(frame: Frame, message: Image) -> Frame:
    """The frame with the depth of a message; without it if that does not fit the image."""
    try:
        return replace(frame, depth_m=depth_from_message(message))
    except InvalidInputError as error:
        log.warning("The depth of %s cannot be used: %s", frame.camera, error)
        return frame


def why_no_image(host: Host) -> str:
    """What to do when a camera sends nothing."""
    view, robot = host.modules.view("perception"), host.modules.view("robot").phase
    if view.phase == "stopped" and robot == "stopped":
        return "The robot is not started: call start_all, or start_robot and then start_perception."
    if view.phase == "running" and robot in ("stopped", "exited"):
        return (
            f"Perception runs, but the robot is {robot}, and the cameras of a simulated robot need "
            "it: call start_robot."
        )
    if view.phase == "running" and view.plan is not None:
        load = overload()
        return (
            f"Perception runs with the cameras: {view.plan.names.get('cameras', 'none')}. If it is "
            f"one of them, its picture is late{f' ({load})' if load else ''}: look again."
        )
    if view.phase in ("starting", "stopping"):
        return f"Perception is {view.phase}: wait for that, then try again."
    if view.phase == "exited":
        return (
            "Perception ended by itself: see get_logs. Unless it is restarted by itself, call "
            "start_perception."
        )
    return "Call start_perception first."


def pose_topic(namespace: str, arm: str = "") -> str:
    """Topic of the measured TCP pose, of the named arm if there are several."""
    return f"/{namespace}/{f'{arm}/' if arm else ''}ee_pose"


def pose_of(message: PoseStamped | None) -> Pose | None:
    """geometry_msgs/PoseStamped -> Pose; None without a message, and for a damaged one."""
    if message is None:
        return None
    try:
        return pose_from_message(message)
    except InvalidInputError as error:
        log.warning("A measured pose cannot be used: %s", error)
        return None
