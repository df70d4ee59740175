"""Pictures of all cameras of a robot, and where each camera was when it took them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import Frame, Pose, RobotProfile
from roboneuron.contract.locator import CalibratedImage
from roboneuron.server.host import Host
from roboneuron.sight.inputs import (
    Inputs,
    depth_topic,
    image_topic,
    pose_of,
    pose_topic,
    why_no_image,
)
from roboneuron.sight.pose_history import PoseHistory

_OLDEST_S = 2.0
"""Older pictures do not tell where things are now."""
_WAIT_S = 0.8
_BLIND_S = 3.0
"""Longest wait for a first picture while perception runs: an overloaded computer serves a new
subscription late, and an agent that sees nothing can do nothing but look again.
"""
_POLL_S = 0.01
_KEPT_S = 5.0
"""Time that subscriptions stay after a view: an agent that works looks again within seconds, and
decoding pictures that nobody looks at costs time.
"""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CellView:
    """What the cameras show at one moment.

    Attributes:
        images: of the cameras whose place is known.
        frames: of all cameras that sent a picture that is not too old.
        problems: why a camera is not among the images, and the call that helps, by its name.
        tcps: newest TCP pose of each arm, by its name; "" for the only one.
        taken_ns: when it was put together, system clock [ns].
        taken_s: likewise, monotonic [s].
    """

    images: tuple[CalibratedImage, ...]
    frames: tuple[Frame, ...]
    problems: Mapping[str, str]
    tcps: Mapping[str, Pose]
    taken_ns: int
    taken_s: float


class _Poses:
    """Pose history of one arm, which the thread of the ROS node adds to."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._history = PoseHistory()

    def add(self, message: Any) -> None:
        pose = pose_of(message)
        if pose is not None:
            with self._lock:
                self._history.add(pose)

    def at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        with self._lock:
            return self._history.at(stamp_ns)


class _CellWatch:
    """Subscriptions to the cameras and arms of a robot.

    Attributes:
        profile: of the robot.
        cameras: those that it subscribes to.
        deep: those of them whose depth it subscribes to.
    """

    def __init__(self, host: Host, profile: RobotProfile | None, table_m: float) -> None:
        self._host, self.profile = host, profile
        self._table_m = table_m
        self._space = host.config.namespace
        self.inputs = Inputs(host, age_factor=np.inf)
        self.cameras = tuple(host.loop.camera_roles())
        self.deep = deep_cameras(host, self.cameras)
        arms = () if profile is None else profile.each_arm
        self._arms = tuple(dict.fromkeys(["", *(arm.name for arm in arms)]))
        self._poses = {arm: _Poses() for arm in self._arms}

    def open(self) -> None:
        """Subscribe; the poses first. Raises RoboNeuronError: ROS cannot be joined."""
        for arm, poses in self._poses.items():
            topic = pose_topic(self._space, arm)
            self.inputs.open(topic, "geometry_msgs/msg/PoseStamped", poses.add)
        for camera in self.cameras:
            topic = image_topic(self._space, camera)
            self.inputs.open_camera(topic, with_depth=camera in self.deep)

    def view(self, newer_than_ns: int, since_s: float) -> CellView:
        """What has arrived so far.

        Args:
            newer_than_ns: only pictures taken later, ROS clock [ns].
            since_s: only pictures that have arrived since then, monotonic [s].
        """
        frames = {camera: self._frame(camera, newer_than_ns, since_s) for camera in self.cameras}
        found = {camera: self._judge(frame) for camera, frame in frames.items()}
        return CellView(
            images=tuple(one for one in found.values() if isinstance(one, CalibratedImage)),
            frames=tuple(one for one in frames.values() if isinstance(one, Frame)),
            problems={camera: one for camera, one in found.items() if isinstance(one, str)},
            tcps=self._tcps(),
            taken_ns=time.time_ns(),
            taken_s=time.monotonic(),
        )

    def is_complete(self, view: CellView) -> bool:
        """True if waiting longer does not help: what is missing was never calibrated."""
        bare = {frame.camera for frame in view.frames if not self._is_mounted(frame.camera)}
        late = {frame.camera for frame in view.frames if frame.depth_m is None} & self.deep
        return view.problems.keys() <= bare and not late

    def _is_mounted(self, camera: str) -> bool:
        known = None if self.profile is None else self.profile.camera(camera)
        return known is not None and known.calibration is not None

    def _frame(self, camera: str, newer_than_ns: int, since_s: float) -> Frame | str:
        """The newest picture, or why there is none."""
        topic = image_topic(self._space, camera)
        if stands := self._host.clock(self._space).stands:
            since_s = -np.inf  # nothing changes until it goes on
        frame = self.inputs.frame(topic, camera, self.profile, since_s)
        if frame is None:
            return f"It sends no picture. {why_no_image(self._host)}"
        age_s = (time.time_ns() - frame.stamp_ns) / 1e9
        if age_s > _OLDEST_S and not stands:
            return f"Its newest picture is {age_s:.1f} s old. See get_status, perception."
        if frame.stamp_ns <= newer_than_ns:
            return "It has sent no picture since the motion. Call look again."
        return frame

    def _judge(self, frame: Frame | str) -> CalibratedImage | str:
        """The placed picture of a camera, or why there is none."""
        if isinstance(frame, str):
            return frame
        calibration = frame.calibration
        if calibration is None:
            return "It is not calibrated for pictures of this size: it tells no places."
        if calibration.arm is None:
            return self._placed(frame, calibration.T_mount_camera)
        poses = self._poses.get(calibration.arm)
        tcp = None if poses is None else poses.at(frame.stamp_ns)
        if tcp is not None:
            return self._placed(frame, tcp @ calibration.T_mount_camera)
        if self.inputs.last(pose_topic(self._space, calibration.arm)) is None:
            if self._host.modules.view("control").phase != "running":
                return "The arm that carries it is not measured. Call start_control."
            return "The pose of the arm that carries it is late: see get_status, and call again."
        return "The arm that carries it moves. Call look again when it rests."

    def _placed(self, frame: Frame, T_base_camera: NDArray[np.float64]) -> CalibratedImage:
        return CalibratedImage(frame=frame, T_base_camera=T_base_camera, table_m=self._table_m)

    def _tcps(self) -> dict[str, Pose]:
        poses = {arm: pose_of(self.inputs.last(pose_topic(self._space, arm))) for arm in self._arms}
        several = self.profile is not None and bool(self.profile.arms)
        return {
            arm: pose for arm, pose in poses.items() if pose is not None and (arm or not several)
        }


def deep_cameras(host: Host, cameras: Iterable[str]) -> set[str]:
    """Those of the cameras whose depth is published."""
    topics = {camera: image_topic(host.config.namespace, camera) for camera in cameras}
    return {one for one, topic in topics.items() if host.graph.publishers(depth_topic(topic))}


class CellViews:
    """Views of the cell of a robot. The subscriptions stay for some seconds after a view: the next
    one need not wait until its publishers know of it. Usable from any thread.
    """

    def __init__(self, kept_s: float = _KEPT_S) -> None:
        """Args:
        kept_s: time that subscriptions stay after a view [s].
        """
        self._kept_s = kept_s
        # held while subscriptions are made or removed, never while a picture is awaited
        self._lock = threading.Lock()
        self._watch: _CellWatch | None = None
        self._is_outdated = False
        self._users = 0
        self._end: threading.Timer | None = None

    def take(
        self,
        host: Host,
        profile: RobotProfile | None,
        *,
        table_m: float,
        newer_than_ns: int = 0,
        wait_s: float = _WAIT_S,
        blind_s: float = _BLIND_S,
    ) -> CellView:
        """Take the next picture of each camera; blocks until all have one with a known place, and
        for at most `wait_s`; for the first of them for up to `blind_s`, while perception runs.

        Args:
            host: of the feature.
            profile: of the present robot; without one no camera is calibrated.
            table_m: height of the table's top in the base frame [m].
            newer_than_ns: only pictures taken later, ROS clock [ns].
            wait_s: longest wait for the pictures of all cameras [s].
            blind_s: longest wait for a first picture [s].

        Raises:
            RoboNeuronError: ROS cannot be joined.
        """
        began_s = time.monotonic()
        with self._lock:
            watch = self._opened(host, profile, table_m)
            self._users += 1
        try:
            view = watch.view(newer_than_ns, began_s)
            while not watch.is_complete(view):
                is_blind = not view.frames and host.modules.view("perception").phase == "running"
                if time.monotonic() >= began_s + (max(wait_s, blind_s) if is_blind else wait_s):
                    break
                time.sleep(_POLL_S)
                view = watch.view(newer_than_ns, began_s)
            return view
        finally:
            with self._lock:
                self._users -= 1
                self._end_later()

    def renew(self) -> None:
        """Subscribe anew for the next view: what was received may not hold any more. Returns at
        once, so that the thread of the ROS node may call it.
        """
        self._is_outdated = True

    def close(self) -> None:
        """Unsubscribe; idempotent."""
        with self._lock:
            if self._end is not None:
                self._end.cancel()
            self._close()

    def _opened(self, host: Host, profile: RobotProfile | None, table_m: float) -> _CellWatch:
        """The watch of a profile. Raises RoboNeuronError."""
        if self._end is not None:
            self._end.cancel()
        watch = self._watch
        if watch is not None and watch.profile is profile and not self._is_outdated:
            cameras = tuple(host.loop.camera_roles())
            if watch.cameras == cameras and watch.deep == deep_cameras(host, cameras):
                return watch
        self._close()
        self._is_outdated = False
        watch = _CellWatch(host, profile, table_m)
        try:
            watch.open()
        except BaseException:
            watch.inputs.close()
            raise
        self._watch = watch
        return watch

    def _end_later(self) -> None:
        if self._end is not None:
            self._end.cancel()
        self._end = threading.Timer(self._kept_s, self._end_unused)
        self._end.daemon = True
        self._end.start()

    def _end_unused(self) -> None:
        with self._lock:
            if not self._users:
                self._close()

    def _close(self) -> None:
        if self._watch is not None:
            self._watch.inputs.close()
        self._watch = None
