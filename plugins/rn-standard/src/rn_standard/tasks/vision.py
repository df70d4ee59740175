"""Detection of a coloured object in calibrated images: one or two views, numpy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron import CameraCalibration, Observation, Pose, matrix_from_quaternion

F64 = NDArray[np.float64]

HUES_DEG = {
    "red": (-14.0, 13.0),
    "orange": (16.0, 37.0),
    "yellow": (41.0, 68.0),
    "green": (85.0, 165.0),
    "blue": (200.0, 250.0),
    "purple": (262.0, 315.0),
}
"""Lowest and highest hue of each colour [deg]; hues in the gaps have no colour."""
_SATURATION, _VALUE = 0.45, 0.15
"""Minimum saturation and value: grey, pale and dark pixels have no colour."""
_LEAST_PX = 16
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
        colour: a key of `HUES_DEG`.

    Returns:
        The centre of the visible part, and True if the edge of the image cuts it.
    """
    step = max(1, image.shape[1] // _WIDTH_PX)
    image = image[::step, ::step]
    rows, columns = np.nonzero(_mask(image, colour))
    if len(rows) < _LEAST_PX:
        return None
    points = np.column_stack([columns, rows]) + 0.5
    cells, counts = np.unique(points // _CELL_PX, axis=0, return_counts=True)
    centre: F64 = (cells[np.argmax(counts)] + 0.5) * _CELL_PX
    radius = 1.5 * _CELL_PX
    for _ in range(8):  # mean shift, growing to the size of the cluster
        near = points[np.hypot(*(points - centre).T) <= radius]
        if len(near) < _LEAST_PX:
            return None
        centre, radius = near.mean(axis=0), max(radius, 1.8 * float(np.sqrt(len(near) / np.pi)))
    height, width = image.shape[:2]
    low, high = near.min(axis=0), near.max(axis=0)
    is_cut = bool(low.min() < 1 or high[0] > width - 1 or high[1] > height - 1)
    return centre * step, is_cut


def _mask(image: NDArray[np.uint8], colour: str) -> NDArray[np.bool_]:
    high, low = image.max(axis=2).astype(np.float64), image.min(axis=2).astype(np.float64)
    spread = high - low
    vivid = (spread >= _SATURATION * high) & (high >= _VALUE * 255) & (spread > 0)
    mask = np.zeros(vivid.shape, dtype=np.bool_)
    red, green, blue = image[vivid].astype(np.float64).T
    top, width = high[vivid], spread[vivid]
    sector = np.select(
        [top == red, top == green],
        [(green - blue) / width, 2.0 + (blue - red) / width],
        4.0 + (red - green) / width,
    )
    first, last = HUES_DEG[colour]
    mask[vivid] = (60.0 * sector - first) % 360.0 <= last - first
    return mask


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
        pose = calibration.T_mount_camera
        if tcp is not None:
            mount = np.eye(4)
            mount[:3, :3], mount[:3, 3] = (
                matrix_from_quaternion(tcp.quaternion_xyzw),
                tcp.position_m,
            )
            pose = mount @ pose
        direction = pose[:3, :3] @ np.linalg.solve(calibration.intrinsics, np.append(centre, 1.0))
        rays[role] = Ray(
            origin=pose[:3, 3], direction=direction / np.linalg.norm(direction), is_coarse=is_cut
        )
    return rays


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
