"""Subscriptions to the robot's topics: joints, TCP poses, actions, commands, images."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rn_view.sources.source import Source
from rn_view.visualization.predicted_path import PlannedChunk
from roboneuron import (
    ACTION_LABEL,
    InvalidInputError,
    RobotProfile,
    image_from_message,
    joints_from_message,
    pose_from_message,
)

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseStamped
    from sensor_msgs.msg import Image, JointState
    from std_msgs.msg import Float64MultiArray, String
    from trajectory_msgs.msg import JointTrajectory

log = logging.getLogger(__name__)
U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]
M = TypeVar("M")
_ACTIONS, _TRAIL = 6000, 400
_LEAST_STEP_M = 0.002
"""The trail gets a point when the TCP has moved this far."""


class ShownAction(NamedTuple):
    """One action.

    Attributes:
        at_s: time of arrival [s], as `Source.now_s`.
        label: of its control space.
        values: as sent.
    """

    at_s: float
    label: str
    values: tuple[float, ...]


class TcpTrack:
    """Measured TCP of one arm, and its trail.

    Attributes:
        pose: measured position [m] (3,) and orientation wxyz (4,) in the base frame; None before
            the first.
        trail: positions [m], oldest first.
    """

    def __init__(self) -> None:
        self.pose: tuple[F64, F64] | None = None
        self.trail: deque[F64] = deque(maxlen=_TRAIL)

    def add(self, message: PoseStamped) -> None:
        """Add a measured pose."""
        pose = pose_from_message(message)
        position = pose.position_m
        self.pose = position, np.roll(pose.quaternion_xyzw, 1)
        if not self.trail or np.linalg.norm(position - self.trail[-1]) > _LEAST_STEP_M:
            self.trail.append(position)

    def clear(self) -> None:
        """Drop pose and trail."""
        self.pose = None
        self.trail.clear()


class MeasuredTopics:
    """Newest messages of the topics; subscribed from `open` to `close`. Fields may be read from any
    thread.

    Attributes:
        joints: measured position [rad or m] by joint name.
        tracks: TCP of each arm by its name; "" for an only arm.
        commanded: positions of the last command by joint name; empty before the first.
        actions: the newest actions, oldest first.
        chunk: newest action chunk of the policy; None if it is not published.
        images: newest image by camera: its number, pixels (H, W, 3) and capture time [ns].
        news: notified with every image.
    """

    def __init__(self, source: Source, profile: RobotProfile) -> None:
        self._source = source
        self._profile = profile
        self._ends: list[Callable[[], None]] = []
        self.joints: dict[str, float] = {}
        self.tracks = {arm.name: TcpTrack() for arm in profile.each_arm}
        self.commanded: dict[str, float] = {}
        self.chunk: PlannedChunk | None = None
        self.actions: deque[ShownAction] = deque(maxlen=_ACTIONS)
        self.images: dict[str, tuple[int, U8, int]] = {}
        self.news = threading.Condition()

    def open(self) -> None:
        """Subscribe. Raises RoboNeuronError if the ROS graph cannot be joined."""
        from geometry_msgs.msg import PoseStamped  # heavy
        from sensor_msgs.msg import Image, JointState
        from std_msgs.msg import Float64MultiArray, String
        from trajectory_msgs.msg import JointTrajectory

        control = self._source.config().control
        self._take(JointState, "joint_states", self._on_joints)
        for arm, track in self.tracks.items():
            self._take(PoseStamped, f"{arm}/ee_pose" if arm else "ee_pose", track.add)
        self._take(Float64MultiArray, "action", self._on_action)
        self._take(String, "predictions", self._on_prediction)
        if control is not None and control.command == "joint_state":
            self._take(JointState, "joint_command", self._on_command_state)
        else:
            self._take(JointTrajectory, "joint_trajectory", self._on_command)
        if self._source.playback is not None:
            self._ends.append(self._source.playback.listen(self.clear))
        for camera in self._profile.cameras:
            self._take(Image, f"camera/{camera.name}/image", partial(self._on_image, camera.name))

    def close(self) -> None:
        """End all subscriptions; idempotent."""
        while self._ends:
            self._ends.pop()()

    def clear(self) -> None:
        """Drop what was received before a jump in a recording. Images stay until new ones
        arrive.
        """
        self.joints, self.commanded, self.chunk = {}, {}, None
        for track in self.tracks.values():
            track.clear()
        self.actions.clear()

    def _take(self, message_type: type[M], topic: str, callback: Callable[[M], None]) -> None:
        def take(message: M) -> None:
            # what a foreign node sends is not shown
            with suppress(InvalidInputError):
                callback(message)

        self._ends.append(self._source.subscribe(message_type, topic, take))

    def _on_joints(self, message: JointState) -> None:
        self.joints = _by_name(message)

    def _on_action(self, message: Float64MultiArray) -> None:
        dims = message.layout.dim
        label = dims[0].label if dims else ACTION_LABEL
        # later rows of the plan may follow
        values = message.data[: dims[0].size] if len(dims) > 1 else message.data
        self.actions.append(ShownAction(self._source.now_s(), label, tuple(values)))

    def _on_prediction(self, message: String) -> None:
        self.chunk = PlannedChunk.parse(message.data, self._source.now_s()) or self.chunk

    def _on_command(self, message: JointTrajectory) -> None:
        if message.points:
            self.commanded = dict(
                zip(message.joint_names, message.points[-1].positions, strict=False)
            )

    def _on_command_state(self, message: JointState) -> None:
        self.commanded = _by_name(message)

    def _on_image(self, camera: str, message: Image) -> None:
        pixels = image_from_message(message)
        stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        number = self.images[camera][0] + 1 if camera in self.images else 1
        with self.news:
            self.images[camera] = number, pixels, stamp_ns
            self.news.notify_all()


def _by_name(message: JointState) -> dict[str, float]:
    joints = joints_from_message(message)
    return dict(zip(joints.names, joints.position.tolist(), strict=True))
