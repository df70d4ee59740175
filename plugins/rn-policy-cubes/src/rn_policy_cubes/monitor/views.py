"""What a monitor of the cubes sees: a close view around the TCP and the whole picture, each small.

Both are cut by the camera's calibration, so any size of picture gives the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from roboneuron import CameraCalibration

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

CLOSE_PX, CLOSE_M = 48, 0.19
"""Side of the close view, and the length at the TCP's distance that it shows [m]."""
WHOLE_PX = 56
"""Side of the small whole picture."""


def centre_px(calibration: CameraCalibration, place_m: NDArray[np.floating]) -> F64:
    """Pixel (2,) of a place (3,) in the base frame, for a camera fixed to the base."""
    seen = _in_camera(calibration, place_m)
    pixel: F64 = calibration.intrinsics @ (seen / seen[2])
    return pixel[:2]


def _in_camera(calibration: CameraCalibration, place_m: NDArray[np.floating]) -> F64:
    pose = calibration.T_mount_camera
    seen: F64 = pose[:3, :3].T @ (np.asarray(place_m, dtype=np.float64) - pose[:3, 3])
    return seen


def close_view(picture: U8, calibration: CameraCalibration, tcp_m: NDArray[np.floating]) -> U8:
    """The surroundings of the TCP, uint8 (48, 48, 3), 19 cm wide; pixels outside the picture repeat
    its edge.
    """
    seen = _in_camera(calibration, tcp_m)
    focal = calibration.intrinsics[[0, 1], [0, 1]]
    step = CLOSE_M / CLOSE_PX * focal / max(float(seen[2]), 1e-3)
    centre = centre_px(calibration, tcp_m)
    offsets = np.arange(CLOSE_PX) - (CLOSE_PX - 1) / 2
    height, width = picture.shape[:2]
    columns = np.clip(np.floor(centre[0] + offsets * step[0]), 0, width - 1).astype(int)
    rows = np.clip(np.floor(centre[1] + offsets * step[1]), 0, height - 1).astype(int)
    view: U8 = picture[rows[:, None], columns[None]]
    return view


def whole_view(picture: U8) -> U8:
    """The whole picture, uint8 (56, 56, 3): means of blocks, after cutting to a square."""
    side = min(picture.shape[:2])
    block = max(1, side // WHOLE_PX)
    if block * WHOLE_PX > side:
        picture = np.repeat(np.repeat(picture, 2, axis=0), 2, axis=1)
        return whole_view(picture)
    top, left = (picture.shape[0] - side) // 2, (picture.shape[1] - side) // 2
    square = picture[top : top + side, left : left + side]
    if side % WHOLE_PX:
        index = np.floor((np.arange(WHOLE_PX) + 0.5) * side / WHOLE_PX).astype(int)
        return np.ascontiguousarray(square[index[:, None], index[None]])
    blocks = square.reshape(WHOLE_PX, block, WHOLE_PX, block, 3)
    mean: U8 = blocks.mean(axis=(1, 3)).astype(np.uint8)
    return mean
