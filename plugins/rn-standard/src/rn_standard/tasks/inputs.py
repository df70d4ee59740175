"""Newest messages of the robot and its cameras on the topics that a task uses."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from rn_standard.direct_path.fields import load_type
from roboneuron import (
    Frame,
    Host,
    InvalidInputError,
    Pose,
    RoboNeuronError,
    RobotProfile,
    frame_from_buffer,
)

if TYPE_CHECKING:
    from builtin_interfaces.msg import Time
    from geometry_msgs.msg import PoseStamped

log = logging.getLogger(__name__)
_AGE_S, _IMAGE_AGE_S = 0.5, 2.0
"""Maximum age of measurements, and of images."""


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
        self._decoded: dict[str, tuple[object, Frame]] = {}

    def open(self, topic: str, type_name: str) -> None:
        """Subscribe to a topic. Raises RoboNeuronError for an unknown type, or if ROS cannot be
        joined.
        """
        _ = self._host.graph  # first: two threads must not import rclpy at the same time
        ros_type = load_type(type_name)

        def take(message: object) -> None:
            self._newest[topic] = time.monotonic(), message

        self._ends.append(self._host.subscribe(ros_type, topic, take, latched=True))

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

    def frame(self, topic: str, camera: str, profile: RobotProfile | None) -> Frame | None:
        """The newest image of a camera, with the calibration of the profile; None if it is
        too old.
        """
        message = self.newest(topic, _IMAGE_AGE_S)
        if message is None:
            return None
        decoded = self._decoded.get(camera)
        if decoded is not None and decoded[0] is message:
            return decoded[1]
        try:
            pixels = frame_from_buffer(
                message.data,
                width=message.width,
                height=message.height,
                step=message.step,
                encoding=message.encoding,
            )
        except InvalidInputError as error:
            log.warning("An image of %s cannot be read: %s", camera, error)
            return None
        known = profile.camera(camera) if profile is not None else None
        frame = Frame(
            camera=camera,
            image=pixels,
            stamp_ns=_stamp_ns(message.header.stamp),
            frame_id=message.header.frame_id or camera,
            calibration=None
            if known is None
            else known.calibration_at(message.width, message.height),
        )
        self._decoded[camera] = (message, frame)
        return frame

    def close(self) -> None:
        """Unsubscribe; idempotent."""
        while self._ends:
            with suppress(RoboNeuronError):
                self._ends.pop()()


def _stamp_ns(stamp: Time) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def pose_topic(namespace: str, arm: str = "") -> str:
    """Topic of the measured TCP pose, of the named arm if there are several."""
    return f"/{namespace}/{f'{arm}/' if arm else ''}ee_pose"


def pose_of(message: PoseStamped | None) -> Pose | None:
    """geometry_msgs/PoseStamped -> Pose."""
    if message is None:
        return None
    p, q = message.pose.position, message.pose.orientation
    return Pose(
        position_m=np.array([p.x, p.y, p.z]),
        quaternion_xyzw=np.array([q.x, q.y, q.z, q.w]),
        stamp_ns=_stamp_ns(message.header.stamp),
    )
