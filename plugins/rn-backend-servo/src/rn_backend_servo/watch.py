"""Checks of images for content and age: black, blank, repeated and frozen images are refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron import Frame, Pose, UngroundedError

F64 = NDArray[np.float64]

_DARK = 24
"""Brightest value below which an image is black."""
_EVEN = 1.5
"""Standard deviation of the values (of 255) below which an image is blank."""
_STRIDE = 4
_FROZEN_M, _FROZEN_UNSYNCHRONISED_M = 0.02, 0.10
"""TCP motion between two identical images above which they count as frozen: by the images' times,
or without comparable times.
"""
_OLD_POSE_NS = 500_000_000
"""Age of a pose relative to the image above which it is outdated; continuing would move the arm
blindly.
"""

_BEHIND_NS = 400_000_000
"""Age of a repeated image relative to the newest one of another camera up to which it is
accepted.
"""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Reference:
    """The first of a series of identical images, with the TCP position."""

    image: NDArray[np.uint8]
    tcp_m: F64
    is_synchronised: bool


class FrameWatch:
    """Checks the images of one camera during an episode."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._reference: _Reference | None = None

    def check(
        self,
        frame: Frame,
        pose: Pose,
        T_base_tcp: F64 | None,
        *,
        newest_ns: int,
        must_change: bool = True,
    ) -> None:
        """Accept `frame`, or raise the reason why it cannot be used.

        Args:
            frame: the image.
            pose: the newest measured TCP pose.
            T_base_tcp: the TCP pose (4, 4) at the time of the image; None if unknown.
            newest_ns: capture time of the newest image of any camera; cameras alternate, so one of
                them may repeat its last image while another has a new one.
            must_change: True if the image must change when the arm moves. It need not for a hand
                camera that sees only the held object and an even table.

        Raises:
            UngroundedError: the image is black, blank, repeated, or frozen while the arm moves; or
                the pose is much older than the image.
        """
        who = f"The image of camera {frame.camera!r}"
        sample = frame.image[::_STRIDE, ::_STRIDE]
        if int(sample.max()) < _DARK:
            raise UngroundedError(f"{who} is black.", hint="Check the camera and the light.")
        if float(sample.std(axis=(0, 1)).max()) < _EVEN:
            raise UngroundedError(f"{who} is blank: one colour all over.", hint="Check the camera.")
        if frame.stamp_ns - pose.stamp_ns > _OLD_POSE_NS:
            age_s = (frame.stamp_ns - pose.stamp_ns) / 1e9
            raise UngroundedError(
                f"The measured TCP pose is {age_s:.1f} s older than the image.",
                hint="Is control running?",
            )
        is_behind = newest_ns == frame.stamp_ns or newest_ns - frame.stamp_ns > _BEHIND_NS
        if frame.stamp_ns == self._stamp_ns and is_behind:
            raise UngroundedError(
                f"{who} is the previous one; no new image has arrived.",
                hint="Is perception running?",
            )
        if must_change:
            self._check_frozen(frame, pose, T_base_tcp, who)
        else:
            self._reference = None
        self._stamp_ns = frame.stamp_ns

    def _check_frozen(self, frame: Frame, pose: Pose, T_base_tcp: F64 | None, who: str) -> None:
        tcp_m = pose.position_m if T_base_tcp is None else T_base_tcp[:3, 3]
        reference = self._reference
        if reference is None or not np.array_equal(reference.image, frame.image):
            self._reference = _Reference(
                image=frame.image.copy(), tcp_m=tcp_m.copy(), is_synchronised=T_base_tcp is not None
            )
            return
        moved_m = float(np.linalg.norm(tcp_m - reference.tcp_m))
        is_synchronised = T_base_tcp is not None and reference.is_synchronised
        if moved_m > (_FROZEN_M if is_synchronised else _FROZEN_UNSYNCHRONISED_M):
            raise UngroundedError(
                f"{who} is frozen: it has not changed while the arm moved {moved_m * 100:.0f} cm.",
                hint="Restart perception.",
            )
