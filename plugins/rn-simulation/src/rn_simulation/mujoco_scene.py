"""Shared by all MuJoCo worlds of RoboNeuron: URDF import, and ray casting on the CPU instead of
OpenGL rendering.

MuJoCo's own renderer needs OpenGL from the system (EGL or OSMesa), which pip cannot install; its
ray caster has no dependency, and renders boxes and cylinders faster than software OpenGL.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

VISUAL_GROUP = 1
"""Group of the rendered geoms; MuJoCo's URDF import puts `<visual>` there and `<collision>` into
group 0.
"""
_DRAWN = np.array([group == VISUAL_GROUP for group in range(mujoco.mjNGROUP)], dtype=np.uint8)
_COMPILER = '<mujoco><compiler discardvisual="false" fusestatic="false"/></mujoco>'


def read_urdf(urdf: str) -> mujoco.MjSpec:
    """Import the robot into MuJoCo, with its visual shapes and every link."""
    return mujoco.MjSpec.from_string(urdf.replace("</robot>", f"{_COMPILER}</robot>"))


def cast_rays(
    model: mujoco.MjModel, data: mujoco.MjData, origin: F64, directions: F64, far_m: float
) -> tuple[NDArray[np.int32], F64, F64]:
    """Cast rays from `origin` (3,) [m] along `directions` (n, 3), of unit length, onto the rendered
    geoms.

    Args:
        model, data: the world; body poses are up to date.
        far_m: maximum distance.

    Returns:
        int32 (n,), the geom or -1; float64 (n,), the distance to it [m]; and float64 (n, 3), its
        unit surface normal.
    """
    count = len(directions)
    geoms, distances, normals = (
        np.empty(count, dtype=np.int32),
        np.empty(count),
        np.empty(3 * count),
    )
    rays = np.ascontiguousarray(directions).ravel()
    mujoco.mj_multiRay(
        model, data, origin, rays, _DRAWN, True, -1, geoms, distances, normals, count, far_m
    )
    return geoms, distances, normals.reshape(-1, 3)
