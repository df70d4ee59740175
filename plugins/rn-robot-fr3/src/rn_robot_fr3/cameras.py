"""The two cameras: where they are, what they look at, and their calibration for any image size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rn_robot_fr3.cell import FACING_M, FR3, Cell
from roboneuron import CameraCalibration, CameraProfile

F64 = NDArray[np.float64]

DEFAULT_SIZE_PX = (224, 224)
"""Nominal width and height: what most VLA models take."""


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
        """The camera as the robot's profile lists it."""
        return CameraProfile(
            name=self.name,
            role=self.role,
            frame_id=self.frame_id,
            width=width,
            height=height,
            calibration=self.calibration(width, height),
        )


def _front() -> PinholeCamera:
    eye, target = np.array([1.22, 0.42, 0.78]), np.array([0.37, -0.02, 0.19])
    return PinholeCamera(
        name="front",
        role="primary",
        frame_id="front_camera_optical_frame",
        mount="base",
        T_mount_camera=look_at(eye, target, np.array([0.0, 0.0, 1.0])),
        vertical_view_rad=np.deg2rad(49.0),
    )


def _wrist() -> PinholeCamera:
    """In front of the hand (+x of the TCP frame), looking along the fingers and tilted back towards
    their tips.
    """
    eye = np.array([0.085, 0.0, -0.080])
    tilt = np.deg2rad(16.0)
    ahead = eye + np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    return PinholeCamera(
        name="wrist",
        role="wrist",
        frame_id="wrist_camera_optical_frame",
        mount="tcp",
        T_mount_camera=look_at(eye, ahead, np.array([1.0, 0.0, 0.0])),
        vertical_view_rad=np.deg2rad(80.0),
    )


def _beside_both() -> PinholeCamera:
    """Beside the table of two arms, looking at both, and between their hands."""
    eye, target = np.array([1.15, -1.45, 0.95]), np.array([FACING_M / 2.0, 0.0, 0.22])
    return replace(_front(), T_mount_camera=look_at(eye, target, np.array([0.0, 0.0, 1.0])))


def cell_cameras(cell: Cell) -> tuple[PinholeCamera, ...]:
    """The cameras of a cell: "front" beside the table and one on each hand."""
    if cell is FR3:
        return cameras()
    wrists = [
        replace(
            _wrist(),
            name=f"{mount.name}_wrist",
            role="wrist" if number == 0 else f"{mount.name}_wrist",
            frame_id=f"{mount.name}_wrist_camera_optical_frame",
            mount="tcp" if number == 0 else f"{mount.name}/tcp",
        )
        for number, mount in enumerate(cell.mounts)
    ]
    return (_beside_both(), *wrists)


def cameras() -> tuple[PinholeCamera, ...]:
    """The cameras of the simulated FR3 cell: "front" beside the table and "wrist" on the hand."""
    return (_front(), _wrist())
