"""The locator `depth`: whatever stands on the table, as boxes, from depth images; numpy only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import CalibratedImage, LocatedObject
from roboneuron.errors import StateError
from roboneuron.sight.footprint import Footprint, footprint_of
from roboneuron.sight.surface import (
    LEVEL_M,
    DepthBlob,
    TablePlane,
    blobs_above,
    places_of,
    table_of,
    top_of,
)

_QUARTER = np.pi / 2
_SQUARE = 0.12
"""Largest difference of the sides of a footprint that counts as square, as a part of the longer."""
_HIDDEN = 0.06
"""Part of an outline that may be cut off of an object that is seen whole."""
_WIDTHS, _SPREADS, _FLOOR_M = 0.3, 1.2, 0.0012
"""Uncertainty in widths of a pixel at the object, in deviations of the depth, and at least."""
_PARTLY, _PARTLY_M = 0.75, 0.02
"""Uncertainty of a partly hidden object, in the longer side of what is seen, and at least."""
_LEAST_PART_M, _MOST_SLENDER = 0.015, 3.0
"""Of a partly hidden object at least so much is seen, and at most so many times as high as long:
others are slivers of something, or pieces of the arm.
"""
_SIDE_PX, _LOWEST = 8.0, 5
"""A side that is higher in the picture is seen; its lowest points are too, but for so many."""
_FLOATS = 0.35
"""Distance of the lowest point that is seen of an object from the table, as a part of its height,
above which it does not stand there.
"""
_SAME_M = 0.01
_DISAGREEING = 1.5
"""Uncertainty in distances of the farthest box of an object from its centre: any of several cameras
that disagree may be the right one.
"""
_ELSEWHERE = 1.2
"""A camera that is turned is farther off at other places than where it was compared."""
_GRAZING = 0.05
"""Least sine of the elevation of a camera over an object that tells its uncertainty."""


class DepthOptions(BaseModel):
    """Options of the locator `depth`; heights are over the table."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    table_slack_m: float = Field(
        default=0.02, gt=0, le=0.1, description="Largest distance of the table from its height [m]."
    )
    least_height_m: float = Field(
        default=0.008, gt=0.002, le=0.2, description="Height of the lowest objects [m]."
    )
    most_height_m: float = Field(
        default=0.25, gt=0, le=2, description="Height of the highest; higher is the robot [m]."
    )
    most_length_m: float = Field(
        default=0.4, gt=0, le=2, description="Length of the longest objects [m]."
    )
    nearest_m: float = Field(
        default=0.12, ge=0, le=2, description="Nearer to a camera is the hand that carries it [m]."
    )
    base_radius_m: float = Field(
        default=0.2, ge=0, le=2, description="Nearer to the robot's base is the robot [m]."
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SurfaceBox:
    """An object in one picture.

    Attributes:
        image: the picture.
        box_px: float64 (4,), left, upper, right and lower edge in the picture.
        foot: its footprint.
        bottom_m, top_m: base frame.
        uncertainty_m: of its centre.
        is_whole: as in `LocatedObject`.
        is_assumed: nothing below its top is seen.
    """

    image: CalibratedImage
    box_px: F64
    foot: Footprint
    bottom_m: float
    top_m: float
    uncertainty_m: float
    is_whole: bool
    is_assumed: bool

    @property
    def centre_m(self) -> F64:
        """Centre (3,)."""
        return np.append(self.foot.centre_m, (self.bottom_m + self.top_m) / 2)


class DepthLocator:
    """Implementation of `roboneuron.contract.locator.Locator`.

    It tells no labels. Things that touch at the same height are one object, and so is a stack.
    """

    def __init__(self, config: DepthOptions | None) -> None:
        self._options = config or DepthOptions()
        self._is_loaded = False

    def load(self) -> None:
        """See `Locator`; nothing is loaded."""
        self._is_loaded = True

    def close(self) -> None:
        """See `Locator`."""
        self._is_loaded = False

    def locate(self, images: Sequence[CalibratedImage]) -> Sequence[LocatedObject]:
        """See `Locator`; pictures without depth show nothing."""
        if not self._is_loaded:
            raise StateError("The locator 'depth' is not loaded.")
        boxes = [box for image in images for box in surface_boxes(image, self._options)]
        groups = _groups(boxes)
        doubt_m = _doubt_m(groups)
        found = []
        for group in groups:
            one = told_box(group)
            if sum(box.is_whole for box in group) < 2:  # the cameras were not compared there
                one = replace(one, uncertainty_m=one.uncertainty_m + doubt_m)
            found.append(one)
        return found


def surface_boxes(image: CalibratedImage, options: DepthOptions) -> Iterator[SurfaceBox]:
    """Boxes of what stands on the table in one picture; none without depth."""
    depth_m = image.frame.depth_m
    if depth_m is None:
        return
    depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(np.nan))
    places = places_of(image, depth_m)
    table = table_of(places, image.table_m, options.table_slack_m)
    least_m = max(options.least_height_m, 5.0 * table.noise_m)
    for blob in blobs_above(image, depth_m, places, table, least_m):
        foot = footprint_of(blob.outline_m)
        if _is_object(blob, foot, options):
            yield _box(image, blob, foot, table, least_m, options)


def _is_object(blob: DepthBlob, foot: Footprint, options: DepthOptions) -> bool:
    is_robot = (
        blob.heights_m.max() > options.most_height_m
        or blob.nearest_m < options.nearest_m
        or np.linalg.norm(foot.centre_m) < options.base_radius_m
    )
    long_m = float(foot.size_m.max())
    is_sized = foot.size_m.min() > 0.0 and long_m <= options.most_length_m
    is_piece = not _is_whole(blob) and (
        long_m < _LEAST_PART_M or blob.heights_m.max() > _MOST_SLENDER * long_m
    )
    return bool(is_sized and not is_robot and not is_piece)


def _box(
    image: CalibratedImage,
    blob: DepthBlob,
    foot: Footprint,
    table: TablePlane,
    least_m: float,
    options: DepthOptions,
) -> SurfaceBox:
    """The box of a surface that was looked for above `least_m` over the table."""
    highest_m = top_of(blob.heights_m)
    top_m = float(np.median(blob.heights_m[blob.heights_m > highest_m - LEVEL_M]))
    lowest_m = float(np.partition(blob.heights_m, _LOWEST)[_LOWEST])
    away = blob.points_m.mean(axis=0) - image.T_base_camera[:3, 3]
    slope = max(_GRAZING, abs(float(away[2])) / float(np.linalg.norm(away)))
    width_m = blob.depth_m / float(image.view.intrinsics[0, 0])
    is_side_seen = top_m * np.sqrt(1 - slope**2) / width_m >= _SIDE_PX
    is_whole = _is_whole(blob)
    is_bottom_seen = lowest_m - least_m <= _FLOATS * top_m
    floats = bool(is_whole and is_side_seen and not is_bottom_seen)
    ground_m = float(table.at(foot.centre_m))
    off_m = abs(ground_m - image.table_m) if table.is_seen else options.table_slack_m
    uncertainty_m = max(_FLOOR_M, off_m + _SPREADS * table.noise_m + _WIDTHS * width_m / slope)
    if not is_whole:
        uncertainty_m += max(_PARTLY_M, _PARTLY * float(foot.size_m.max()))
    return SurfaceBox(
        image=image,
        box_px=blob.box_px,
        foot=foot,
        bottom_m=ground_m + (lowest_m if floats else 0.0),
        top_m=ground_m + top_m,
        uncertainty_m=uncertainty_m,
        is_whole=is_whole,
        is_assumed=not (is_bottom_seen or floats),
    )


def _is_whole(blob: DepthBlob) -> bool:
    return not blob.is_cut and blob.hidden <= _HIDDEN


def _groups(boxes: Sequence[SurfaceBox]) -> list[list[SurfaceBox]]:
    """Boxes by object: the best seen first, each with those of other pictures whose middle is in
    it, or that have its middle in them.
    """
    left = sorted(
        boxes, key=lambda box: (not box.is_whole, box.uncertainty_m, box.image.frame.camera)
    )
    groups = []
    while left:
        first = left.pop(0)
        same = [box for box in left if box.image is not first.image and _is_same(first, box)]
        left = [box for box in left if box not in same]
        groups.append([first, *same])
    return groups


def _doubt_m(groups: Sequence[Sequence[SurfaceBox]]) -> float:
    """How far from its calibration a camera is: the least distance of what two cameras tell of one
    whole object, 0 if their uncertainties explain it, or if they see none together. What one camera
    alone sees whole may be as far off.
    """
    seen = [[box for box in group if box.is_whole] for group in groups]
    pairs = [group[:2] for group in seen if len(group) > 1]
    doubts_m = []
    for one, other in pairs:
        apart_m = float(np.linalg.norm(one.centre_m - other.centre_m))
        is_explained = apart_m <= one.uncertainty_m + other.uncertainty_m
        doubts_m.append(0.0 if is_explained else _ELSEWHERE * apart_m)
    return min(doubts_m, default=0.0)


def _is_same(one: SurfaceBox, other: SurfaceBox) -> bool:
    meet = one.foot.holds(other.foot.centre_m, _SAME_M) or other.foot.holds(
        one.foot.centre_m, _SAME_M
    )
    return meet and one.bottom_m < other.top_m and other.bottom_m < one.top_m


def told_box(group: Sequence[SurfaceBox], label: str = "object") -> LocatedObject:
    """The object of boxes, the best first."""
    best = group[0]
    good = [box for box in group if box.is_whole] or [best]
    weights = np.array([box.uncertainty_m**-2 for box in good])
    centres = np.stack([box.centre_m for box in good])
    centre = weights @ centres / weights.sum()
    apart_m = float(np.linalg.norm(centres - centre, axis=1).max())
    long_m, wide_m = float(best.foot.size_m.max()), float(best.foot.size_m.min())
    is_square = long_m - wide_m <= _SQUARE * long_m
    yaw = best.foot.yaw_rad
    size = [*best.foot.size_m, best.top_m - best.bottom_m]
    frames = [box.image.frame for box in group]
    return LocatedObject(
        label=label,
        position_m=centre,
        yaw_rad=yaw,
        symmetry_rad=_QUARTER if is_square else np.pi,
        size_m=np.array(size),
        uncertainty_m=best.uncertainty_m + _DISAGREEING * apart_m,
        cameras=tuple(dict.fromkeys(frame.camera for frame in frames)),
        seen_at_ns=min(frame.stamp_ns for frame in frames),
        is_whole=best.is_whole,
        is_height_assumed=all(box.is_assumed for box in group),
    )
