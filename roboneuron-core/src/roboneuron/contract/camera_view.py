"""Pinhole cameras at known poses: intersection of a pixel's ray with a plane, and projection of
points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.contract.observation import CameraCalibration


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CameraView:
    """A pinhole camera at a known pose.

    Attributes:
        intrinsics: float64 (3, 3) [px].
        T_base_camera: float64 (4, 4), optical frame in the base frame.
    """

    intrinsics: F64
    T_base_camera: F64

    @classmethod
    def of(cls, calibration: CameraCalibration, T_base_tcp: F64) -> CameraView:
        """The view of a camera on the base, or on a TCP at `T_base_tcp` (4, 4)."""
        mount = np.eye(4) if calibration.arm is None else T_base_tcp
        return cls(
            intrinsics=calibration.intrinsics, T_base_camera=mount @ calibration.T_mount_camera
        )

    def project(self, points_m: F64) -> F64:
        """Project points (..., 3) in the base frame to pixels (..., 2); NaN for points behind the
        camera.
        """
        rotation, origin = self.T_base_camera[:3, :3], self.T_base_camera[:3, 3]
        camera = (points_m - origin) @ rotation
        depth = np.where(camera[..., 2:] > 1e-6, camera[..., 2:], np.nan)
        homogeneous = (camera / depth) @ self.intrinsics.T
        pixels: F64 = homogeneous[..., :2]
        return pixels

    def meet_plane(self, pixel: F64, height_m: float) -> F64 | None:
        """Intersection (3,) of the ray through `pixel` (2,) with z = `height_m`, in the base frame;
        None if there is none.
        """
        ray = self.T_base_camera[:3, :3] @ np.linalg.solve(
            self.intrinsics, np.array([pixel[0], pixel[1], 1.0])
        )
        origin = self.T_base_camera[:3, 3]
        if abs(ray[2]) < 1e-9:
            return None
        distance = (height_m - origin[2]) / ray[2]
        if distance <= 0:
            return None
        point: F64 = origin + distance * ray
        return point
