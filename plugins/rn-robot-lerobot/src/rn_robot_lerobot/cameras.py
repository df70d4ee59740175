"""The cameras of the SO-101's cell: "front" beside the table and "wrist" on the gripper."""

from __future__ import annotations

import numpy as np

from rn_simulation.pinhole import PinholeCamera, look_at


def cameras() -> tuple[PinholeCamera, ...]:
    """Both cameras, as they are simulated."""
    return (_front(), _wrist())


def _front() -> PinholeCamera:
    eye, target = np.array([0.52, -0.26, 0.40]), np.array([0.19, 0.0, 0.05])
    return PinholeCamera(
        name="front",
        role="primary",
        frame_id="front_camera_optical_frame",
        mount="base",
        T_mount_camera=look_at(eye, target, np.array([0.0, 0.0, 1.0])),
        vertical_view_rad=np.deg2rad(45.0),
    )


def _wrist() -> PinholeCamera:
    """Behind the fixed jaw, looking along it and tilted towards its tip."""
    eye = np.array([0.075, 0.0, -0.055])
    tilt = np.deg2rad(35.0)
    ahead = eye + np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    return PinholeCamera(
        name="wrist",
        role="wrist",
        frame_id="wrist_camera_optical_frame",
        mount="tcp",
        T_mount_camera=look_at(eye, ahead, np.array([1.0, 0.0, 0.0])),
        vertical_view_rad=np.deg2rad(75.0),
    )
