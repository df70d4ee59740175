"""The two cameras: where they are, what they look at, and their calibration for any image size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rn_robot_fr3.cell import FACING_M, FR3, Cell
from rn_simulation.pinhole import PinholeCamera, look_at


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
