"""The two cameras: poses, and calibration for any image size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rn_robot_fr3.cell import FACING_M, FR3, Workcell
from rn_simulation.pinhole import UP, PinholeCamera, front_camera, look_at, wrist_camera


def _front() -> PinholeCamera:
    return front_camera((1.22, 0.42, 0.78), (0.37, -0.02, 0.19), 49.0)


def _wrist() -> PinholeCamera:
    return wrist_camera((0.085, 0.0, -0.080), 16.0, 80.0)


def _beside_both() -> PinholeCamera:
    """Camera next to the table of two arms, with both arms and the space between the hands in
    view.
    """
    eye, target = np.array([1.15, -1.45, 0.95]), np.array([FACING_M / 2.0, 0.0, 0.22])
    return replace(_front(), T_mount_camera=look_at(eye, target, UP))


def cell_cameras(cell: Workcell) -> tuple[PinholeCamera, ...]:
    """The cameras of a cell: "front" next to the table and one on each hand."""
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
    """The cameras of the simulated FR3 cell: "front" next to the table and "wrist" on the hand."""
    return (_front(), _wrist())
