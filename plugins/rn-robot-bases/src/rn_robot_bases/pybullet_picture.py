"""Images of a platform, rendered by PyBullet on the CPU (TinyRenderer)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pybullet
from numpy.typing import NDArray

from rn_robot_bases.platform import Platform
from rn_robot_bases.pybullet_world import load_body
from rn_simulation.planar_motion import PlanarPose

F64 = NDArray[np.float64]

_CLEARED_DEPTH = 0.99999


def draw_robots(
    platform: Platform,
    poses: Sequence[PlanarPose],
    view: F64,
    projection: F64,
    size: tuple[int, int],
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours (H, W, 3) of the platform at each pose, and a mask of its pixels."""
    client = int(pybullet.connect(pybullet.DIRECT))
    try:
        for pose in poses:
            body = load_body(client, platform)
            inertial = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[3:5]
            heading = pybullet.getQuaternionFromEuler((0.0, 0.0, pose.yaw_rad))
            position, rotation = pybullet.multiplyTransforms(
                (pose.x_m, pose.y_m, 0.0), heading, *inertial
            )
            pybullet.resetBasePositionAndOrientation(
                body, position, rotation, physicsClientId=client
            )
        _, _, pixels, depth, _ = pybullet.getCameraImage(
            *size,
            viewMatrix=view.T.ravel().tolist(),
            projectionMatrix=projection.T.ravel().tolist(),
            lightDirection=[-0.6, -1.0, 2.0],
            lightAmbientCoeff=0.6,
            lightDiffuseCoeff=0.5,
            lightSpecularCoeff=0.05,
            shadow=0,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=client,
        )
    finally:
        pybullet.disconnect(client)
    rgba = np.asarray(pixels, dtype=np.uint8).reshape(size[1], size[0], 4)
    is_robot = np.asarray(depth, dtype=np.float64).reshape(size[1], size[0]) < _CLEARED_DEPTH
    return rgba[:, :, :3], is_robot
