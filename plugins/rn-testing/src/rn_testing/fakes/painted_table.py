"""Pictures of coloured cubes on a table, by cameras of known poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache

import numpy as np
from numpy.typing import NDArray

from roboneuron import CalibratedImage, CameraCalibration, CameraView, Frame
from roboneuron.sight.cube import cube_corners

F64 = NDArray[np.float64]

SIDE_PX = 224
TABLE_RGB = (200, 190, 175)
PAINT_RGB = {"red": (200, 25, 25), "green": (30, 150, 60), "blue": (25, 60, 210)}
Cubes = Mapping[str, tuple[float, float, float]]
"""Colour -> x [m], y [m], yaw [rad] of cubes on the table."""
EDGE_M = 0.044
CUBES: Cubes = {"red": (0.5, 0.1, 0.3), "green": (0.42, -0.1, -0.2), "blue": (0.6, 0.0, 0.6)}
"""Cubes on the default pictures of a case, and the length of their edges."""


def overhead_camera() -> CameraCalibration:
    """A camera 0.8 m above (0.5, 0, 0) in the base frame, looking straight down; up in the image is
    base +x.
    """
    pose = np.array(
        [[0.0, -1.0, 0.0, 0.5], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.8], [0.0, 0.0, 0.0, 1.0]]
    )
    return _camera(pose)


def side_camera() -> CameraCalibration:
    """A camera at (1.1, 0.3, 0.7) in the base frame that looks at (0.5, 0, 0)."""
    eye = np.array([1.1, 0.3, 0.7])
    ahead = np.array([0.5, 0.0, 0.0]) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.column_stack([right, np.cross(ahead, right), ahead]), eye
    return _camera(pose)


def _camera(pose: F64) -> CameraCalibration:
    intrinsics = np.array([[220.0, 0.0, SIDE_PX / 2], [0.0, 220.0, SIDE_PX / 2], [0.0, 0.0, 1.0]])
    return CameraCalibration(intrinsics=intrinsics, mount="base", T_mount_camera=pose)


def paint_cubes(
    camera: CameraCalibration, cubes: Cubes, edge_m: float = 0.044
) -> NDArray[np.uint8]:
    """An image (SIDE_PX, SIDE_PX, 3) by a fixed camera: filled outlines with slight noise."""
    noise = np.random.default_rng(0).integers(-4, 5, (SIDE_PX, SIDE_PX, 3))
    image = np.asarray(TABLE_RGB) + noise
    view = CameraView.of(camera, np.eye(4))
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] + 0.5
    for colour, (x_m, y_m, yaw_rad) in cubes.items():
        corners = view.project(cube_corners(np.array([x_m, y_m, yaw_rad, edge_m]), 0.0))
        image[_inside_hull(corners, columns, rows)] = PAINT_RGB[colour]
    return image.clip(0, 255).astype(np.uint8)


Box = tuple[float, float, float, float, float, float, float]
"""x [m], y [m], yaw [rad], length and width [m], heights of bottom and top over the table [m]."""


def depth_of(camera: CameraCalibration, boxes: Iterable[Box]) -> NDArray[np.float32]:
    """Depth (SIDE_PX, SIDE_PX) [m] by a fixed camera: boxes and the table, without noise. Source:
    the slab method, Kay and Kajiya, "Ray tracing complex scenes", SIGGRAPH 1986.
    """
    pose = camera.T_mount_camera
    rows, columns = np.mgrid[:SIDE_PX, :SIDE_PX] + 0.5
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    rays = pixels @ np.linalg.inv(camera.intrinsics).T @ pose[:3, :3].T
    origin = pose[:3, 3]
    depth_m = np.where(rays[..., 2] < 0, -origin[2] / np.minimum(rays[..., 2], -1e-9), np.nan)
    for x, y, yaw, length, width, bottom, top in boxes:
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        half = np.array([length, width, top - bottom]) / 2
        start = (origin - [x, y, (bottom + top) / 2]) @ turn
        ahead = rays @ turn
        ahead = np.where(np.abs(ahead) < 1e-12, 1e-12, ahead)
        first, second = (-half - start) / ahead, (half - start) / ahead
        enter = np.minimum(first, second).max(axis=-1)
        is_hit = (enter > 0) & (enter <= np.maximum(first, second).min(axis=-1))
        depth_m = np.where(is_hit, np.fmin(depth_m, enter), depth_m)
    return depth_m.astype(np.float32)


def _inside_hull(points: F64, columns: F64, rows: F64) -> NDArray[np.bool_]:
    """Pixels inside the convex hull of `points` (n, 2): in every direction, not beyond the
    outermost point.
    """
    inside = np.ones(columns.shape, dtype=bool)
    for angle in np.linspace(0.0, 2 * np.pi, 180, endpoint=False):
        normal = np.array([np.cos(angle), np.sin(angle)])
        inside &= columns * normal[0] + rows * normal[1] <= (points @ normal).max()
    return inside


def painted(cubes: Cubes) -> tuple[CalibratedImage, ...]:
    """Pictures of cubes on a table from above and from the side, with depth."""
    return tuple(
        CalibratedImage(
            frame=Frame(
                camera=name,
                image=paint_cubes(camera, cubes, EDGE_M),
                stamp_ns=stamp_ns,
                frame_id=name,
                calibration=camera,
                depth_m=depth_of(
                    camera,
                    [(x, y, yaw, EDGE_M, EDGE_M, 0.0, EDGE_M) for x, y, yaw in cubes.values()],
                ),
            ),
            T_base_camera=camera.T_mount_camera,
        )
        for name, camera, stamp_ns in (
            ("above", overhead_camera(), 7),
            ("side", side_camera(), 5),
        )
    )


@cache
def painted_cubes() -> tuple[CalibratedImage, ...]:
    """The default pictures; to paint them takes longer than to find the cubes."""
    return painted(CUBES)
