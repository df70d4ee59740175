"""Measured pose of the TCP, as published by control."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from roboneuron.contract import Pose
from roboneuron.contract.arrays import F64
from roboneuron.errors import NotReadyError
from roboneuron.server.host import Host
from roboneuron.sight.inputs import pose_of
from roboneuron.supervisor.overload import overload

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseStamped

_AGE_S = 0.5
"""Maximum age of measurements."""
_POLL_S = 0.01
_SPAN_S, _GAP_S = 0.2, 0.5
"""Times between which a speed is measured: interruptions are none, and control's stamps are late by
different times (within 0.1 s an arm that moves at 0.112 m/s seemed to move at 0.119 on a busy
machine, which reads as a limit that did not hold).
"""
_KEPT_S, BUCKET_S = 3600, 0.25
"""Time for which speeds are kept, by parts of a second."""


class SpeedMeter:
    """Highest speeds of the TCP, by parts of a second; written by one thread, read by any."""

    def __init__(self) -> None:
        self._from: tuple[float, F64] | None = None
        self._speeds: deque[tuple[float, float]] = deque(maxlen=int(_KEPT_S / BUCKET_S))

    def note(self, stamp_s: float, position_m: F64, now_s: float) -> None:
        """Add a measurement: its time by the robot's stamp [s], position of the TCP (3,) [m], and
        the monotonic time of its arrival.
        """
        if self._from is None or not 0 <= stamp_s - self._from[0] <= _GAP_S:
            self._from = stamp_s, position_m
            return
        past_s = stamp_s - self._from[0]
        if past_s < _SPAN_S:
            return
        speed_m_s = float(np.linalg.norm(position_m - self._from[1])) / past_s
        self._from = stamp_s, position_m
        if self._speeds and now_s - self._speeds[-1][0] < BUCKET_S:
            began_s, before = self._speeds[-1]
            self._speeds[-1] = began_s, max(before, speed_m_s)
        else:
            self._speeds.append((now_s, speed_m_s))

    def fastest_since(self, since_s: float) -> float | None:
        """Highest speed [m/s] since a monotonic time [s], to `BUCKET_S`; None if not measured."""
        speeds = [speed for at_s, speed in tuple(self._speeds) if at_s > since_s - BUCKET_S]
        return max(speeds, default=None)


class MeasuredPose:
    """Subscribes to `ee_pose` of one arm on first use; usable from any thread."""

    def __init__(self, host: Host, namespace: str, arm: str = "") -> None:
        """Args:
        host: host of the feature.
        namespace: namespace of the robot.
        arm: name of one of several arms; "" for the only one.
        """
        self._host = host
        self._topic = f"/{namespace}/{f'{arm}/' if arm else ''}ee_pose"
        # of several first callers only one subscribes
        self._lock = threading.Lock()
        self._is_open = False
        self._newest: tuple[float, Pose] | None = None
        self.speeds = SpeedMeter()
        self.listeners: list[Callable[[float], object]] = []
        """Called with the height of the TCP [m] of each message, on the thread of the ROS node."""

    def wait(self, timeout_s: float, newer_than_ns: int = 0) -> Pose:
        """Return the pose, not older than 0.5 s and measured after `newer_than_ns` [ROS time, ns];
        waits for one, but not beyond a stop of the arm.

        Raises:
            NotReadyError: control publishes none.
            StateError: the arm was stopped, or has lost a module.
            RoboNeuronError: ROS cannot be joined.
        """
        self.open()
        deadline_s = time.monotonic() + timeout_s
        starts = self._host.loop.starts
        stops, arm_stops = starts.stops, starts.arm_stops
        while True:
            newest = self._newest
            if newest is not None and time.monotonic() - newest[0] <= _AGE_S:
                pose = newest[1]
                if pose.stamp_ns > newer_than_ns:
                    return pose
            is_late = time.monotonic() > deadline_s
            if is_late:
                starts.look()  # a module that was lost just now has published none
            if starts.arm_stops != arm_stops:
                starts.check(stops)
            if is_late:
                raise NotReadyError(
                    "Control publishes no pose of the end effector.", hint=self._hint()
                )
            time.sleep(_POLL_S)

    def _hint(self) -> str:
        """What to do when no pose comes."""
        is_own = self._topic.startswith(f"/{self._host.config.namespace}/")
        has_ended = self._host.modules.view("robot").phase in ("stopped", "exited")
        if is_own and has_ended:
            return "Call start_robot first."
        load = overload()
        if self._newest is None or not load:
            return "See get_status."
        age_s = time.monotonic() - self._newest[0]
        return (
            f"The last one is {age_s:.1f} s old: {load}. Once it is less, call again for what is "
            "left."
        )

    def open(self) -> None:
        """Subscribe; does nothing the second time. Raises RoboNeuronError if ROS cannot be
        joined.
        """
        _ = self._host.graph  # first: two threads must not import rclpy at the same time
        from geometry_msgs.msg import PoseStamped  # heavy

        with self._lock:
            if not self._is_open:
                self._host.subscribe(PoseStamped, self._topic, self._take)
                self._is_open = True

    def _take(self, message: PoseStamped) -> None:
        pose, now_s = pose_of(message), time.monotonic()
        if pose is None:
            return
        self._newest = now_s, pose
        self.speeds.note(pose.stamp_ns / 1e9, pose.position_m, now_s)
        for listener in self.listeners:
            listener(float(pose.position_m[2]))
