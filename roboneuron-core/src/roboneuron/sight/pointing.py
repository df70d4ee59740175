"""The place that a pixel shows: on an object, or on the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import CalibratedImage, LocatedObject
from roboneuron.errors import RefusedError
from roboneuron.sight.rays import Ray, ray_through

POINTING_PX = 1.5
"""A pixel is pointed at within this distance with a probability of 95 %."""
_TABLE_M = 0.002
"""Deviation of a table's height, and of a camera's place."""
MOST_M = 0.10
"""Places that are less certain are not told."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PointedPlace:
    """A place on a surface.

    Attributes:
        position_m: float64 (3,), base frame.
        uncertainty_m: it is within this distance with a probability of 95 %.
        surface: "object", "depth" or "table".
        number: index of the object; None elsewhere.
    """

    position_m: F64
    uncertainty_m: float
    surface: str
    number: int | None = None


def place_at(image: CalibratedImage, pixel: F64, objects: Sequence[LocatedObject]) -> PointedPlace:
    """The place on the nearest surface in the line of sight of a pixel (2,) of the image.

    Raises:
        RefusedError: rule `above_horizon` or `too_far`.
    """
    ray = ray_through(image.view, pixel)
    hits = [
        (along_m, number)
        for number, one in enumerate(objects)
        if (along_m := distance_to_box(ray, one)) is not None
    ]
    if hits:
        along_m, number = min(hits)
        return PointedPlace(
            position_m=ray.origin + along_m * ray.direction,
            uncertainty_m=objects[number].uncertainty_m + _width_m(image, along_m),
            surface="object",
            number=number,
        )
    depth_m = _depth_at(image, pixel)
    if depth_m is not None:
        forward = float(ray.direction @ image.T_base_camera[:3, 2])
        along_m = depth_m / forward
        return _certain(ray, along_m, _width_m(image, along_m) + 0.01 * along_m, "depth")
    return _on_table(image, pixel)


def _on_table(image: CalibratedImage, pixel: F64) -> PointedPlace:
    ray = ray_through(image.view, pixel)
    place = ray.at_height(image.table_m)
    if place is None:
        raise RefusedError(
            "The pixel lies above the horizon: its line of sight meets no table.",
            hint="Point lower, or at an object.",
            rule="above_horizon",
        )
    along_m = float(np.linalg.norm(place - ray.origin))
    slope = max(1e-3, -float(ray.direction[2]))
    spread_m = float(np.hypot(_width_m(image, along_m), _TABLE_M * np.sqrt(1 - slope**2))) / slope
    return _certain(ray, along_m, spread_m, "table")


def _certain(ray: Ray, along_m: float, uncertainty_m: float, surface: str) -> PointedPlace:
    if uncertainty_m > MOST_M:
        raise RefusedError(
            f"The place is {along_m:.1f} m from the camera and uncertain by "
            f"{uncertainty_m * 100:.0f} cm: too far to be told.",
            hint=f"At most {MOST_M * 100:.0f} cm: point at something nearer, or use another "
            "camera.",
            rule="too_far",
        )
    return PointedPlace(
        position_m=ray.origin + along_m * ray.direction,
        uncertainty_m=uncertainty_m,
        surface=surface,
    )


def _width_m(image: CalibratedImage, along_m: float) -> float:
    """Width that pointing within `POINTING_PX` covers at a distance."""
    return POINTING_PX * along_m / float(image.view.intrinsics[0, 0])


def _depth_at(image: CalibratedImage, pixel: F64) -> float | None:
    depth_m = image.frame.depth_m
    if depth_m is None:
        return None
    value = float(depth_m[int(pixel[1]), int(pixel[0])])
    return value if np.isfinite(value) and value > 0 else None


def distance_to_box(ray: Ray, one: LocatedObject) -> float | None:
    """Distance along a ray to the box of an object [m]; None if it passes beside. Source: the slab
    method, Kay and Kajiya, "Ray tracing complex scenes", SIGGRAPH 1986.
    """
    yaw = one.yaw_rad or 0.0
    axes = np.array(
        [[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
    )
    origin, direction = axes @ (ray.origin - one.position_m), axes @ ray.direction
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    first, second = (-one.size_m / 2 - origin) / direction, (one.size_m / 2 - origin) / direction
    enter_m = float(np.minimum(first, second).max())
    leave_m = float(np.maximum(first, second).min())
    return enter_m if 0 < enter_m <= leave_m else None
