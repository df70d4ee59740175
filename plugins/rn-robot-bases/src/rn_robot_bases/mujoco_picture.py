"""Images of a platform: one ray per pixel, cast by MuJoCo on the CPU, because its own renderer
needs OpenGL.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from rn_robot_bases.description import urdf
from rn_robot_bases.platform import Platform
from rn_simulation.mujoco_scene import cast_rays, read_urdf
from rn_simulation.planar_motion import PlanarPose

F64 = NDArray[np.float64]

_AMBIENT, _DIFFUSE = 0.6, 0.5
_LIGHT_DIRECTION = np.array([-0.6, -1.0, 2.0])
_FAR_M = 1000.0


def draw_robots(
    platform: Platform,
    poses: Sequence[PlanarPose],
    view: F64,
    projection: F64,
    size: tuple[int, int],
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours (H, W, 3) of the platform at each pose, and a mask of its pixels."""
    scene = mujoco.MjSpec()
    for index, pose in enumerate(poses):
        turn = (math.cos(pose.yaw_rad / 2), 0.0, 0.0, math.sin(pose.yaw_rad / 2))
        place = scene.worldbody.add_frame(pos=(pose.x_m, pose.y_m, 0.0), quat=turn)
        scene.attach(read_urdf(urdf(platform)), frame=place, prefix=f"{index}/")
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    origin, rays = _rays(view, projection, size)
    geoms, _, normals = cast_rays(model, data, origin, rays, _FAR_M)
    light = _LIGHT_DIRECTION / np.linalg.norm(_LIGHT_DIRECTION)
    brightness = _AMBIENT + _DIFFUSE * np.maximum(normals @ light, 0.0)
    colours = np.minimum(255.0 * model.geom_rgba[geoms, :3] * brightness[:, None], 255.0).astype(
        np.uint8
    )
    return colours.reshape(size[1], size[0], 3), (geoms >= 0).reshape(size[1], size[0])


def _rays(view: F64, projection: F64, size: tuple[int, int]) -> tuple[F64, F64]:
    """Camera position, and a unit direction (H * W, 3) for each pixel, row by row."""
    width, height = size
    x, y = np.meshgrid(
        (np.arange(width) + 0.5) / width * 2.0 - 1.0, 1.0 - (np.arange(height) + 0.5) / height * 2.0
    )
    seen = np.column_stack(
        [x.ravel() / projection[0, 0], y.ravel() / projection[1, 1], -np.ones(width * height)]
    )
    rays = seen @ view[:3, :3]
    directions: F64 = rays / np.linalg.norm(rays, axis=1)[:, None]
    return -view[:3, :3].T @ view[:3, 3], directions
