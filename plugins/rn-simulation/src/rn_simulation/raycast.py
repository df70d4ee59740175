"""Images of a MuJoCo world: one ray per pixel, cast by MuJoCo on the CPU."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
from numpy.typing import NDArray

from rn_simulation.light import AMBIENT, DIFFUSE, LIGHT_DIRECTION, backdrop
from rn_simulation.mujoco_scene import cast_rays
from roboneuron import CameraCalibration

F64 = NDArray[np.float64]

FAR_M = 8.0


def render(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    calibration: CameraCalibration,
    T_base_mount: F64,
    width: int,
    height: int,
) -> NDArray[np.uint8]:
    """Render a camera's image, uint8 (H, W, 3) RGB, without shadows; rays go through the middle of
    each pixel.

    Args:
        model, data: the world; body poses are up to date.
        calibration: intrinsics for `width` x `height` and the camera's pose in its mount frame.
        T_base_mount: float64 (4, 4), pose of the mount frame in the base frame.
    """
    pose = T_base_mount @ calibration.T_mount_camera
    rays = _rays(tuple(calibration.intrinsics.ravel().tolist()), width, height) @ pose[:3, :3].T
    geoms, normals = cast_rays(model, data, np.ascontiguousarray(pose[:3, 3]), rays, FAR_M)
    hit = np.flatnonzero(geoms >= 0)
    light = np.array(LIGHT_DIRECTION) / np.linalg.norm(LIGHT_DIRECTION)
    brightness = AMBIENT + DIFFUSE * np.maximum(normals[hit] @ light, 0.0)
    image = np.broadcast_to(backdrop(height), (height, width, 3)).reshape(-1, 3).copy()
    image[hit] = (255.0 * model.geom_rgba[:, :3])[geoms[hit]] * brightness.astype(np.float32)[
        :, None
    ]
    return image.reshape(height, width, 3)


@functools.lru_cache(maxsize=4)
def _rays(intrinsics: tuple[float, ...], width: int, height: int) -> F64:
    """Directions (H * W, 3) of unit length in the camera's optical frame, row by row."""
    fx, _, cx, _, fy, cy, *_ = intrinsics
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x = (u.ravel() - cx) / fx
    y = (v.ravel() - cy) / fy
    rays = np.column_stack([x, y, np.ones_like(x)])
    directions: F64 = rays / np.linalg.norm(rays, axis=1)[:, None]
    return directions
