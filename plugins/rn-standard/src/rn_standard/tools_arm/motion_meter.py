"""Highest speed of a TCP during a motion, and distances to the joints' limits."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from rn_standard.sight.inputs import Inputs, pose_of, pose_topic
from roboneuron import Host, JointSample, Pose, RobotProfile

_SPAN_NS = 80_000_000
"""Least time between the poses of which a speed is computed: those between two of control's are
late by different times.
"""


class MotionMeter:
    """Measures from `open` to `close`."""

    def __init__(self, host: Host, arm: str) -> None:
        """Args:
        host: of the feature.
        arm: name of one of several arms; "" for the only one.
        """
        self._inputs = Inputs(host)
        self._topic = pose_topic(host.config.namespace, arm)
        self._poses: deque[Pose] = deque(maxlen=100)
        self._highest_m_s = 0.0
        self._count = 0

    def open(self) -> None:
        """Begin. Raises RoboNeuronError if ROS cannot be joined."""
        self._inputs.open(self._topic, "geometry_msgs/msg/PoseStamped", self.note)

    def note(self, message: Any) -> None:
        """Take a measured pose (geometry_msgs/PoseStamped)."""
        pose = pose_of(message)
        assert pose is not None
        self._poses.append(pose)
        self._count += 1
        while len(self._poses) > 2 and pose.stamp_ns - self._poses[1].stamp_ns >= _SPAN_NS:
            self._poses.popleft()
        span_ns = pose.stamp_ns - self._poses[0].stamp_ns
        if span_ns >= _SPAN_NS:
            far_m = float(np.linalg.norm(pose.position_m - self._poses[0].position_m))
            self._highest_m_s = max(self._highest_m_s, far_m / (span_ns / 1e9))

    @property
    def highest_m_s(self) -> float | None:
        """Highest speed so far [m/s]; None if nothing was measured."""
        return round(self._highest_m_s, 3) if self._count > 1 else None

    def close(self) -> None:
        """End; idempotent."""
        self._inputs.close()


def joint_margin(profile: RobotProfile | None, joints: JointSample | None) -> dict[str, float]:
    """The joint that is nearest to one of its position limits, and the distance [rad or m]; empty
    if it is not known.
    """
    if profile is None or profile.limits is None or joints is None:
        return {}
    here = dict(zip(joints.names, joints.position.tolist(), strict=True))
    margins = {
        name: min(here[name] - lower, upper - here[name])
        for name, lower, upper in zip(
            profile.arm_joints,
            profile.limits.lower.tolist(),
            profile.limits.upper.tolist(),
            strict=True,
        )
        if name in here and np.isfinite([lower, upper]).all()
    }
    nearest = min(margins, key=margins.__getitem__, default="")
    return {nearest: round(margins[nearest], 4)} if nearest else {}
