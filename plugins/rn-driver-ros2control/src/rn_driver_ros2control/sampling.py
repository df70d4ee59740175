"""Positions on the way of a `JointTrajectory`, as joint_trajectory_controller interpolates them.

Pure computation: time is an argument.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

F64 = NDArray[np.float64]


class TrajectorySampler:
    """The trajectory that is executed now, in the order of its controller's joints.

    Source: documentation of joint_trajectory_controller (trajectory.rst): linear between positions,
    cubic if the end of a segment has velocities.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        """Begin without a trajectory."""
        self.joints = tuple(joints)
        self._points: list[tuple[float, F64, F64 | None]] = []

    @property
    def end_s(self) -> float | None:
        """Time of the last point; None without a trajectory."""
        return self._points[-1][0] if self._points else None

    def start(
        self, trajectory: JointTrajectory, now_s: float, position: F64, velocity: F64
    ) -> None:
        """Replace the trajectory; times count from its stamp, or from now without one.

        Args:
            trajectory: joints in any order; those that it does not name stay.
            now_s: present time, on the clock of the stamp [s].
            position, velocity: of the joints now, float64 (n,).
        """
        stamp_s = trajectory.header.stamp.sec + trajectory.header.stamp.nanosec * 1e-9
        begin_s = stamp_s or now_s
        names = list(trajectory.joint_names)
        order = [names.index(name) if name in names else -1 for name in self.joints]
        self._points = [(now_s, position.copy(), velocity.copy())]
        for point in trajectory.points:
            due_s = begin_s + seconds(point)
            if due_s <= now_s and point is not trajectory.points[-1]:
                continue  # the past part is dropped
            place = np.array(
                [point.positions[i] if i >= 0 else b for i, b in zip(order, position, strict=True)]
            )
            moving = None
            if len(point.velocities):
                moving = np.array([point.velocities[i] if i >= 0 else 0.0 for i in order])
            self._points.append((max(due_s, now_s), place, moving))

    def clear(self) -> None:
        """Forget the trajectory."""
        self._points = []

    def sample(self, now_s: float) -> tuple[F64, F64] | None:
        """Position and velocity at that time, float64 (n,); None without a trajectory."""
        if not self._points:
            return None
        for (from_s, p0, v0), (to_s, p1, v1) in zip(self._points, self._points[1:], strict=False):
            if now_s >= to_s or to_s <= from_s:
                continue
            span_s = to_s - from_s
            t = (now_s - from_s) / span_s
            if v1 is None or v0 is None:
                return p0 + (p1 - p0) * t, (p1 - p0) / span_s
            square = 3 * (p1 - p0) - (2 * v0 + v1) * span_s
            cube = 2 * (p0 - p1) + (v0 + v1) * span_s
            position = p0 + v0 * span_s * t + square * t**2 + cube * t**3
            return position, v0 + (2 * square * t + 3 * cube * t**2) / span_s
        last = self._points[-1][1]
        return last.copy(), np.zeros_like(last)


def seconds(point: JointTrajectoryPoint) -> float:
    """Time of a point from the start [s]."""
    return float(point.time_from_start.sec) + float(point.time_from_start.nanosec) * 1e-9
