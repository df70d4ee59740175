"""Detection of frozen cameras: a picture that stays while the arm moves, or is too old."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron import Frame, Observation

OLDEST_S = 1.0
"""Longest time without a new stamp, and longest age of a picture against the measured pose."""
_MOVED_M, _MOVED_OPENING = 0.01, 0.05
"""Motion of the TCP, and of the gripper, that every camera of the cell has to show."""


@dataclass(slots=True)
class _CameraTrace:
    """A camera's newest content, and where the arm was when it was first seen."""

    digest: int
    stamp_ns: int
    stamp_since_s: float
    tcp_m: NDArray[np.float64] | None
    opening: float | None
    is_live: bool = False
    is_frozen: bool = False


class FrozenPictures:
    """Follows the pictures of one attempt. A frozen one says nothing about the present.

    An arm at rest may give equal pictures; once it has moved by 1 cm, or its gripper by a
    twentieth of its way, a picture with the same content is frozen until another one comes. The
    first picture counts once a second one shows that the camera works.
    """

    def __init__(self) -> None:
        self._seen: dict[str, _CameraTrace] = {}

    def look(self, observation: Observation, now_s: float) -> str:
        """Add an observation, in the order of time; return what is wrong with its pictures, or "".

        Args:
            observation: the observation.
            now_s: monotonic time [s].
        """
        found = [
            self._look(role, frame, observation, now_s)
            for role, frame in observation.frames.items()
        ]
        return next((text for text in found if text), "")

    def _look(self, role: str, frame: Frame, observation: Observation, now_s: float) -> str:
        pose, opening = observation.ee_pose, observation.gripper_open
        digest = zlib.crc32(np.ascontiguousarray(frame.image).data)
        seen = self._seen.get(role)
        if seen is None or seen.digest != digest:
            tcp_m = None if pose is None else pose.position_m
            made = _CameraTrace(digest, frame.stamp_ns, now_s, tcp_m, opening)
            if seen is not None and seen.stamp_ns == frame.stamp_ns:
                made.stamp_since_s, made.is_live = seen.stamp_since_s, seen.is_live
            elif seen is not None:
                made.is_live = True
            seen = self._seen[role] = made
        elif seen.stamp_ns != frame.stamp_ns:
            seen.stamp_ns, seen.stamp_since_s, seen.is_live = frame.stamp_ns, now_s, True
        if pose is not None and seen.tcp_m is not None:
            far_m = float(np.linalg.norm(pose.position_m - seen.tcp_m))
            seen.is_frozen |= far_m > _MOVED_M
        if opening is not None and seen.opening is not None:
            seen.is_frozen |= abs(opening - seen.opening) > _MOVED_OPENING
        if seen.is_frozen:
            return f"the picture of {frame.camera!r} has not changed although the arm has moved"
        age_s = now_s - seen.stamp_since_s
        if pose is not None and pose.stamp_ns > 0 and frame.stamp_ns > 0:
            age_s = max(age_s, (pose.stamp_ns - frame.stamp_ns) / 1e9)
        if age_s > OLDEST_S:
            return f"the newest picture of {frame.camera!r} is {age_s:.1f} s old"
        return "" if seen.is_live else f"{frame.camera!r} has sent no second picture yet"
