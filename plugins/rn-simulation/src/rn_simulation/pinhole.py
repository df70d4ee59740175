"""Ideal cameras of simulated robots: poses, and calibration for any image size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from roboneuron import CameraCalibration, CameraProfile

F64 = NDArray[np.float64]

DEFAULT_SIZE_PX = (224, 224)
"""Nominal width and height, which most VLA models use."""


def look_at(eye_m: F64, target_m: F64, up: F64) -> F64:
    """Pose (4, 4) of an optical frame (x right, y down, z forward) at `eye_m` that looks at
    `target_m`.
    """
    z = (target_m - eye_m) / np.linalg.norm(target_m - eye_m)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    pose[:3, 3] = eye_m
    return pose


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PinholeCamera:
    """An ideal pinhole camera with square pixels and its principal point in the middle.

    Attributes:
        name, role, frame_id: as in `CameraProfile`.
        mount: "base", "tcp", or "<arm>/tcp" for an arm after the first.
        T_mount_camera: float64 (4, 4), optical frame in the mount frame [m].
        vertical_view_rad: angle between the top and the bottom edge of the image.
    """

    name: str
    role: str
    frame_id: str
    mount: str
    T_mount_camera: F64
    vertical_view_rad: float

    def calibration(self, width: int, height: int) -> CameraCalibration:
        """Calibration of an image of `width` x `height` [px]; the vertical angle of view stays the
        same.
        """
        focal_px = height / 2.0 / np.tan(self.vertical_view_rad / 2.0)
        intrinsics = np.array(
            [[focal_px, 0.0, width / 2.0], [0.0, focal_px, height / 2.0], [0.0, 0.0, 1.0]]
        )
        return CameraCalibration(
            intrinsics=intrinsics, mount=self.mount, T_mount_camera=self.T_mount_camera.copy()
        )

    def profile(
        self, width: int = DEFAULT_SIZE_PX[0], height: int = DEFAULT_SIZE_PX[1]
    ) -> CameraProfile:
        """The camera's profile."""
        return CameraProfile(
            name=self.name,
            role=self.role,
            frame_id=self.frame_id,
            width=width,
            height=height,
            calibration=self.calibration(width, height),
        )

    def displaced(self, offset_m: Sequence[float] | F64) -> PinholeCamera:
        """The camera moved by an offset (3,) in the base frame [m]; one on a hand stays."""
        if self.mount.endswith("tcp"):
            return self
        pose = self.T_mount_camera.copy()
        pose[:3, 3] += offset_m
        return replace(self, T_mount_camera=pose)


UP = np.array([0.0, 0.0, 1.0])


def front_camera(
    eye_m: Sequence[float], target_m: Sequence[float], vertical_view_deg: float
) -> PinholeCamera:
    """The camera "front" next to the table, which looks from one point of the base frame at
    another.
    """
    return PinholeCamera(
        name="front",
        role="primary",
        frame_id="front_camera_optical_frame",
        mount="base",
        T_mount_camera=look_at(np.array(eye_m), np.array(target_m), UP),
        vertical_view_rad=np.deg2rad(vertical_view_deg),
    )


def wrist_camera(
    eye_m: Sequence[float], tilt_deg: float, vertical_view_deg: float
) -> PinholeCamera:
    """The camera "wrist" on the hand, in front of it (+x of the TCP frame): it looks along the
    fingers, tilted back towards their tips.
    """
    eye, tilt = np.array(eye_m), np.deg2rad(tilt_deg)
    ahead = eye + np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    return PinholeCamera(
        name="wrist",
        role="wrist",
        frame_id="wrist_camera_optical_frame",
        mount="tcp",
        T_mount_camera=look_at(eye, ahead, np.array([1.0, 0.0, 0.0])),
        vertical_view_rad=np.deg2rad(vertical_view_deg),
    )
