"""Lines of sight to a coloured object, and where those of two views meet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import CameraCalibration, Observation, Pose
from roboneuron.contract.arrays import F64
from roboneuron.contract.camera_view import CameraView
from roboneuron.contract.locator import CalibratedImage
from roboneuron.sight.segmentation import LEAST_AREA_PX, colour_mask

__all__ = ["rays_of"]
"""Names that other distributions may use."""


_CELL_PX = 16
_WIDTH_PX = 224
MEET_M = 0.03
"""Largest distance between the rays of two views of one object."""
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

    def meeting(self, other: Ray) -> tuple[F64, float] | None:
        """Point (3,) nearest to this and another ray, and their distance there [m]; None if they
        are nearly parallel.
        """
        normal = np.cross(self.direction, other.direction)
        if np.linalg.norm(normal) < _PARALLEL:
            return None
        system = np.column_stack([self.direction, -other.direction, normal])
        along, beside, _ = np.linalg.solve(system, other.origin - self.origin)
        if along <= 0 or beside <= 0:
            return None
        here = self.origin + along * self.direction
        there = other.origin + beside * other.direction
        return (here + there) / 2, float(np.linalg.norm(here - there))


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
        view = CameraView.of(calibration, np.eye(4) if tcp is None else tcp.matrix)
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


class Shown(Protocol):
    """Something in one picture."""

    @property
    def image(self) -> CalibratedImage:
        """The picture."""


S = TypeVar("S", bound=Shown)


def grouped(shown: Sequence[S], apart_m: Callable[[S, S], float]) -> list[list[S]]:
    """What several pictures show, by object: at most one of each picture, the first of those that
    are left with the nearest to it in every other picture.

    Args:
        shown: the best first.
        apart_m: distance between two of different pictures [m].
    """
    left = list(shown)
    groups = []
    while left:
        first = left.pop(0)
        group = [first]
        for image in {id(one.image): one.image for one in left}.values():
            if image is first.image:
                continue
            near = [
                (distance_m, number)
                for number, one in enumerate(left)
                if one.image is image and (distance_m := apart_m(first, one)) <= MEET_M
            ]
            if near:
                group.append(left.pop(min(near)[1]))
        groups.append(group)
    return groups


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
