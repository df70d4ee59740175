"""Pictures of the calibration board by an exact pinhole camera with a distorting lens and noise."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rn_cameras.board import DOTS_PER_MM, Board
from rn_cameras.calibrating import Calibrated
from rn_cameras.solving import MountedCamera, Optics

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

BOARD = Board()
SIZE = (640, 480)
MATRIX = np.array([[612.0, 0.0, 325.3], [0.0, 609.0, 236.8], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.28, 0.09, 0.0006, -0.0004, 0.0])
NOISE = 3.0
"""Standard deviation of a value of the picture, of 255."""
_DOTS_PER_MM = 4
_BORDER = 60
"""White around the board [dots]."""
_FINER = 2
"""Rays per pixel along each axis, averaged."""


class Lens:
    """A camera that pictures a board at a pose."""

    def __init__(self, board: Board, matrix: F64 = MATRIX, distortion: F64 = DISTORTION) -> None:
        share = _DOTS_PER_MM / DOTS_PER_MM
        dots = cv2.resize(board.draw(), None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
        self._dots = cv2.copyMakeBorder(dots, *[_BORDER] * 4, cv2.BORDER_CONSTANT, value=255)
        steps = (np.arange(0, SIZE[0] * _FINER) + 0.5) / _FINER - 0.5
        u, v = np.meshgrid(steps, steps[: SIZE[1] * _FINER])
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)
        ending = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        rays = cv2.undistortPoints(pixels, matrix, distortion, criteria=ending).reshape(-1, 2)
        self._rays = [rays[:, axis].reshape(u.shape).astype(np.float32) for axis in (0, 1)]
        self._random = np.random.default_rng(7)

    def picture(self, T_camera_board: F64) -> U8:
        """uint8 (480, 640, 3): the board on a grey table."""
        # a point of the board is x r1 + y r2 + t in the camera
        plane = np.column_stack([T_camera_board[:3, :2], T_camera_board[:3, 3]])
        to_plane = np.linalg.inv(plane).astype(np.float32)
        right, down = self._rays
        x, y, depth = (row[0] * right + row[1] * down + row[2] for row in to_plane)
        dots = np.float32(1000 * _DOTS_PER_MM) / np.where(depth > 0, depth, np.nan)
        x, y = (np.nan_to_num(part * dots, nan=-1e6) + np.float32(_BORDER - 0.5) for part in (x, y))
        fine = cv2.remap(
            self._dots, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110
        )
        grey = cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA).astype(np.float64)
        noisy = 20 + 0.8 * grey + self._random.normal(0.0, NOISE, grey.shape)
        return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def pose(rotvec_deg: tuple[float, float, float], place_m: tuple[float, float, float]) -> F64:
    """float64 (4, 4)."""
    made = np.eye(4)
    made[:3, :3] = Rotation.from_rotvec(rotvec_deg, degrees=True).as_matrix()
    made[:3, 3] = place_m
    return made


def before_camera(board: Board, count: int, away_m: float, seed: int = 1) -> list[F64]:
    """Poses T_camera_board (4, 4) of a board that is tilted by up to 40 degrees about several axes,
    in view.
    """
    random = np.random.default_rng(seed)
    middle = np.append(np.array(board.size_m) / 2, 0.0)
    made = []
    for _ in range(count):
        tilt = random.uniform(-38, 38, 3) * (1, 1, 0.7)
        aside = random.uniform(-1, 1, 3) * (0.1 * away_m / 0.5, 0.06 * away_m / 0.5, 0.1)
        found = pose(tuple(tilt), (0, 0, 0))
        found[:3, 3] = np.array([0, 0, away_m]) + aside - found[:3, :3] @ middle
        made.append(found)
    return made


@cache
def views() -> tuple[list[F64], list[U8]]:
    """Fourteen poses T_camera_board, and the pictures of them; made once per process."""
    lens, places = Lens(BOARD), before_camera(BOARD, 14, 0.45)
    return places, [lens.picture(place) for place in places]


def difference(found: F64, true: F64) -> tuple[float, float]:
    """Distance [m] and angle [degrees] between two poses (4, 4)."""
    turn = Rotation.from_matrix(found[:3, :3].T @ true[:3, :3]).magnitude()
    return float(np.linalg.norm(found[:3, 3] - true[:3, 3])), float(np.degrees(turn))


MOUNTED = pose((150, 30, 10), (1.0, 0.2, 0.7))


def calibrated(
    *,
    is_optics_measured: bool = True,
    corners_m: float | None = None,
    error_px: float = 0.2,
    deviation_m: float = 0.001,
    deviation_rad: float = 0.001,
) -> Calibrated:
    """A calibration of the lens above at MOUNTED."""
    optics = Optics(
        size=SIZE, matrix=MATRIX, distortion=DISTORTION, deviation_px=np.ones(4), error_px=0.1
    )
    camera = MountedCamera(
        T_mount_camera=MOUNTED,
        error_px=error_px,
        deviation_m=deviation_m,
        deviation_rad=deviation_rad,
        views=12,
    )
    return Calibrated(
        optics=optics,
        is_optics_measured=is_optics_measured,
        camera=camera,
        corners_m=corners_m,
        left_out={},
    )
