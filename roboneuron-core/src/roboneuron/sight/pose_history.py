"""TCP poses by time: images arrive 100 ms and more after the pose that belongs to them."""

from __future__ import annotations

from collections import deque

import numpy as np

from roboneuron.contract import Pose
from roboneuron.contract.arrays import F64

__all__ = ["PoseHistory"]
"""Names that other distributions may use."""


_LENGTH = 40
_AHEAD_NS = 50_000_000
"""Largest time by which an image may be newer than the newest pose."""
_AT_REST_M = 1e-3


class PoseHistory:
    """The last few seconds of measured TCP poses."""

    def __init__(self) -> None:
        self._poses: deque[Pose] = deque(maxlen=_LENGTH)

    def clear(self) -> None:
        """Delete all poses."""
        self._poses.clear()

    def add(self, pose: Pose) -> None:
        """Add a measured pose; one that is not newer than the last is ignored. If the clock was set
        back, all earlier ones are deleted.
        """
        if self._poses and pose.stamp_ns < self._poses[-1].stamp_ns:
            self._poses.clear()
        if not self._poses or pose.stamp_ns > self._poses[-1].stamp_ns:
            self._poses.append(pose)

    def at(self, stamp_ns: int) -> F64 | None:
        """TCP pose (4, 4) in the base frame at `stamp_ns`, interpolated; None if the motion at that
        time is not known.
        """
        poses = self._poses
        if not poses or stamp_ns > poses[-1].stamp_ns + _AHEAD_NS:
            return None
        if stamp_ns >= poses[-1].stamp_ns:
            return poses[-1].matrix
        for earlier, later in zip(
            reversed(list(poses)[:-1]), reversed(list(poses)[1:]), strict=True
        ):
            if earlier.stamp_ns <= stamp_ns:
                return _between(earlier, later, stamp_ns).matrix
        is_resting = np.linalg.norm(poses[-1].position_m - poses[0].position_m) < _AT_REST_M
        return poses[0].matrix if is_resting else None


def _between(earlier: Pose, later: Pose, stamp_ns: int) -> Pose:
    """Interpolate linearly in position, normalised linearly in rotation: poses are at most a tenth
    of a second apart.
    """
    share = (stamp_ns - earlier.stamp_ns) / (later.stamp_ns - earlier.stamp_ns)
    start, end = earlier.quaternion_xyzw, later.quaternion_xyzw
    quaternion = (1 - share) * start + share * np.copysign(1.0, float(start @ end)) * end
    return Pose(
        position_m=(1 - share) * earlier.position_m + share * later.position_m,
        quaternion_xyzw=quaternion / np.linalg.norm(quaternion),
        stamp_ns=stamp_ns,
    )
