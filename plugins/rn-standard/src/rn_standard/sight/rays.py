"""Lines of sight to a coloured object, and where those of two views meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_standard.sight.segmentation import LEAST_AREA_PX, colour_mask
from rn_standard.sight.view import CameraView, matrix_of
from roboneuron import CameraCalibration, Observation, Pose

F64 = NDArray[np.float64]

_CELL_PX = 16
_WIDTH_PX = 224
_PARALLEL = 0.05
"""Sine of the least angle between two rays that determine a place."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Ray:
    """Line of sight to an object.

    Attributes:
        origin, direction: float64 (3,), in the base frame [m], and of unit length.
        is_coarse: the edge of the image cuts the object, so that its centre is slightly off.
    """

    origin: F64
    direction: F64
    is_coarse: bool = False

    def at_height(self, height_m: float) -> F64 | None:
        """Point (3,) of the ray at that height; None if it does not reach it."""
        if abs(self.direction[2]) < 1e-3:
            return None
        along = (height_m - self.origin[2]) / self.direction[2]
        return None if along <= 0 else self.origin + along * self.direction


def centre_of(image: NDArray[np.uint8], colour: str) -> tuple[F64, bool] | None:
    """Centre (2,) [px] of the largest cluster of a colour in an image (H, W, 3) RGB; None without
    one.

    Args:
        image: the original image; large ones are subsampled.
        colour: a key of `segmentation.HUES_DEG`.

    Returns:
        The centre of the visible part, and True if the edge of the image cuts it.
    """
    step = max(1, image.shape[1] // _WIDTH_PX)
    image = image[::step, ::step]
    rows, columns = np.nonzero(colour_mask(image, colour))
    if len(rows) < LEAST_AREA_PX:
        return None
    points = np.column_stack([columns, rows]) + 0.5
    cells, counts = np.unique(points // _CELL_PX, axis=0, return_counts=True)
    centre: F64 = (cells[np.argmax(counts)] + 0.5) * _CELL_PX
    radius = 1.5 * _CELL_PX
    for _ in range(8):  # mean shift, growing to the size of the cluster
        near = points[np.hypot(*(points - centre).T) <= radius]
        if len(near) < LEAST_AREA_PX:
            return None
        centre, radius = near.mean(axis=0), max(radius, 1.8 * float(np.sqrt(len(near) / np.pi)))
    height, width = image.shape[:2]
    low, high = near.min(axis=0), near.max(axis=0)
    is_cut = bool(low.min() < 1 or high[0] > width - 1 or high[1] > height - 1)
    return centre * step, is_cut


def rays_of(observation: Observation, colour: str) -> dict[str, Ray]:
    """Ray towards the object by role, for every calibrated camera that sees it."""
    rays: dict[str, Ray] = {}
    for role, frame in observation.frames.items():
        calibration = frame.calibration
        if calibration is None:
            continue
        tcp = _carrier(observation, calibration)
        if calibration.arm is not None and tcp is None:
            continue
        seen = centre_of(frame.image, colour)
        if seen is None:
            continue
        centre, is_cut = seen
        view = CameraView.of(calibration, np.eye(4) if tcp is None else matrix_of(tcp))
        rays[role] = ray_through(view, centre, is_coarse=is_cut)
    return rays


def ray_through(view: CameraView, pixel: F64, *, is_coarse: bool = False) -> Ray:
    """Line of sight of a camera through a pixel (2,)."""
    direction = view.T_base_camera[:3, :3] @ np.linalg.solve(view.intrinsics, np.append(pixel, 1.0))
    return Ray(
        origin=view.T_base_camera[:3, 3],
        direction=direction / np.linalg.norm(direction),
        is_coarse=is_coarse,
    )


def _carrier(observation: Observation, calibration: CameraCalibration) -> Pose | None:
    """TCP pose of the arm that carries a camera; None for a fixed camera, and without a
    measurement.
    """
    if calibration.arm is None:
        return None
    if not calibration.arm:
        return observation.ee_pose
    arm = observation.arms.get(calibration.arm)
    return None if arm is None else arm.ee_pose


def crossing(one: Ray, other: Ray) -> tuple[F64, float] | None:
    """Point (3,) nearest to two rays and their distance there [m]; None if they are nearly
    parallel.
    """
    normal = np.cross(one.direction, other.direction)
    if np.linalg.norm(normal) < _PARALLEL:
        return None
    system = np.column_stack([one.direction, -other.direction, normal])
    along, beside, _ = np.linalg.solve(system, other.origin - one.origin)
    if along <= 0 or beside <= 0:
        return None
    here, there = one.origin + along * one.direction, other.origin + beside * other.direction
    return (here + there) / 2, float(np.linalg.norm(here - there))
