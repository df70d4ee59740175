"""Images of a PyBullet world, rendered on the CPU (TinyRenderer), without display or GPU."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pybullet
from numpy.typing import NDArray

from rn_simulation.light import AMBIENT, DIFFUSE, LIGHT_DIRECTION, backdrop
from roboneuron import CameraCalibration

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

NEAR_M = 0.02
FAR_M = 8.0


_CLEARED_DEPTH = 0.99999


def _view(T_base_camera: F64) -> list[float]:
    """OpenGL view matrix, column by column: the GL camera looks along -z with y up."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(T_base_camera)
    return [float(value) for value in matrix.T.ravel()]


def _projection(intrinsics: F64, width: int, height: int) -> list[float]:
    """OpenGL projection matrix, column by column, of a pinhole camera.

    TinyRenderer samples a pixel at its lower left corner, the contract at its centre; the image is
    shifted by that half pixel, left and down (otherwise projected cubes are off by 0.5 px in u and
    in v).
    """
    matrix = np.zeros((4, 4))
    matrix[0, 0] = 2.0 * intrinsics[0, 0] / width
    matrix[1, 1] = 2.0 * intrinsics[1, 1] / height
    matrix[0, 2] = 1.0 - 2.0 * (intrinsics[0, 2] - 0.5) / width
    matrix[1, 2] = 2.0 * (intrinsics[1, 2] + 0.5) / height - 1.0
    matrix[2, 2] = -(FAR_M + NEAR_M) / (FAR_M - NEAR_M)
    matrix[2, 3] = -2.0 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
    matrix[3, 2] = -1.0
    return [float(value) for value in matrix.T.ravel()]


def render(
    client: int, calibration: CameraCalibration, T_base_mount: F64, width: int, height: int
) -> tuple[NDArray[np.uint8], Callable[[], F32]]:
    """Render a camera's image, uint8 (H, W, 3) RGB, without shadows, and a function for its depth,
    see `ArmWorld.render_depth`.

    Args:
        client: PyBullet physics client id.
        calibration: intrinsics for `width` x `height` and the camera's pose in its mount frame.
        T_base_mount: float64 (4, 4), pose of the mount frame in the base frame.
    """
    _, _, pixels, depth, _ = pybullet.getCameraImage(
        width,
        height,
        viewMatrix=_view(T_base_mount @ calibration.T_mount_camera),
        projectionMatrix=_projection(calibration.intrinsics, width, height),
        lightDirection=LIGHT_DIRECTION,
        lightColor=[1.0, 1.0, 1.0],
        lightAmbientCoeff=AMBIENT,
        lightDiffuseCoeff=DIFFUSE,
        lightSpecularCoeff=0.08,
        shadow=0,
        flags=pybullet.ER_NO_SEGMENTATION_MASK,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=client,
    )
    rgba = np.asarray(pixels, dtype=np.uint8).reshape(height, width, 4)
    image = np.ascontiguousarray(rgba[:, :, :3])
    buffer = np.asarray(depth, dtype=np.float32).reshape(height, width)
    empty = buffer >= _CLEARED_DEPTH
    np.copyto(image, backdrop(height), where=empty[:, :, None])

    def depth_m() -> F32:
        along = FAR_M * NEAR_M / (FAR_M - (FAR_M - NEAR_M) * buffer.astype(np.float64))
        return np.where(empty, np.nan, along).astype(np.float32)

    return image, depth_m
