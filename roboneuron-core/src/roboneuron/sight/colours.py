"""The locator `colours`: coloured cubes by their outlines in calibrated pictures, numpy only."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import CalibratedImage, LocatedObject
from roboneuron.errors import StateError
from roboneuron.sight.cube import (
    MOST_SPREADS,
    PIXEL_PX,
    CubeFit,
    fit_cube,
    measure_cube,
    worst_misfit_px,
)
from roboneuron.sight.rays import MEET_M, grouped, ray_through
from roboneuron.sight.segmentation import Blob, Mask, balanced, blobs_of, colour_masks

_QUARTER = np.pi / 2
_P95 = 2.448
"""Radius that holds 95 % of a normal distribution in the plane, in its standard deviations."""
_FLOOR_M = 0.0012
"""Least uncertainty: outlines are drawn in whole pixels."""
_ON_TABLE_M = 0.012
"""Bottoms up to this height above the table are on it: two views place one within a few
millimetres.
"""
_HIDDEN, _ALONE = 0.75, 1.5
"""Uncertainty of an object of which no outline is whole, seen by two cameras and by one, in edges:
part of it is hidden, and one camera cannot tell if it stands on another.
"""
_ELSEWHERE = 1.3
"""Two views of which one was moved are farther off in height than on the table."""
_RING_PX, _BESIDE = 3, 0.12
"""Width of the ring around a region, and the part of it that belongs to an adjoining object."""


_LEAST_SIZE, _MOST_SIZE = 0.35, 1.6
"""Sizes of a partly hidden cube's region, as parts of a whole one's."""


class _Evidence(TypedDict):
    cameras: tuple[str, ...]
    seen_at_ns: int


class ColoursOptions(BaseModel):
    """Options of the locator `colours`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    edge_m: float = Field(
        default=0.044, gt=0.01, le=0.2, description="Usual edge of the cubes [m]."
    )
    edge_spread_m: float = Field(
        default=0.004, gt=0, le=0.05, description="Typical deviation from that edge [m]."
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _ColouredRegion:
    """A region of a colour in one picture.

    Attributes:
        image, blob: picture and region.
        place_m: float64 (3,), centre if it is a cube on the table.
        is_clear: its outline is that of a whole cube there.
        is_beside: another colour adjoins it, whose object may hide it, carry it or stand on it.
    """

    image: CalibratedImage
    blob: Blob
    place_m: F64
    is_clear: bool
    is_beside: bool


class ColourLocator:
    """Implementation of `roboneuron.contract.locator.Locator`.

    A cube that two cameras see is measured in all three directions, so also on another one or in
    the hand; one that a single camera sees is taken to stand on the table.
    """

    def __init__(self, config: ColoursOptions | None) -> None:
        self._options = config or ColoursOptions()
        self._is_loaded = False

    def load(self) -> None:
        """See `Locator`; nothing is loaded."""
        self._is_loaded = True

    def close(self) -> None:
        """See `Locator`."""
        self._is_loaded = False

    def locate(self, images: Sequence[CalibratedImage]) -> Sequence[LocatedObject]:
        """See `Locator`."""
        if not self._is_loaded:
            raise StateError("The locator 'colours' is not loaded.")
        seen: dict[str, list[_ColouredRegion]] = {}
        for image in images:
            masks = dict(colour_masks(balanced(image.frame.image)))
            coloured = np.logical_or.reduce(list(masks.values()))
            for colour, mask in masks.items():
                others = coloured & ~mask
                seen.setdefault(colour, []).extend(self._seen(image, blobs_of(mask), others))
        groups = [
            (colour, group)
            for colour, regions in seen.items()
            for group in grouped(sorted(regions, key=_quality), _apart_m)
        ]
        found = [
            (group, one)
            for colour, group in groups
            if (one := self._located(colour, group)) is not None
        ]
        doubt_m = _doubt_m(found)
        return [replace(one, uncertainty_m=one.uncertainty_m + doubt_m) for _, one in found]

    def _seen(
        self, image: CalibratedImage, blobs: Iterable[Blob], others: Mask
    ) -> Iterator[_ColouredRegion]:
        """Regions that may be cubes, with their places on the table; `others` are the pixels of
        other colours.
        """
        options = self._options
        for blob in blobs:
            estimate = measure_cube(
                blob,
                image.view,
                table_m=image.table_m,
                edge_m=options.edge_m,
                edge_spread_m=options.edge_spread_m,
            )
            if estimate is not None:
                place = np.array([estimate.x_m, estimate.y_m, image.table_m + estimate.edge_m / 2])
                yield _ColouredRegion(
                    image=image,
                    blob=blob,
                    place_m=place,
                    is_clear=estimate.is_clear,
                    is_beside=_is_beside(blob, others),
                )

    def _located(self, colour: str, group: Sequence[_ColouredRegion]) -> LocatedObject | None:
        """The object of a group; None if it cannot be a cube."""
        for chosen in _choices(group):
            place = _meeting(chosen)
            if place is None:
                place = chosen[0].place_m
            fit = self._fit(chosen, place, is_free=True) if len(chosen) > 1 else None
            if fit is None or fit.parameters[4] - group[0].image.table_m < _ON_TABLE_M:
                on_table = self._fit(chosen, place, is_free=False)
                fit = on_table if on_table is not None else fit
            if fit is not None:
                return self._whole(colour, chosen, fit)
        return self._hidden(colour, group)

    def _fit(self, seen: Sequence[_ColouredRegion], place: F64, *, is_free: bool) -> CubeFit | None:
        """The cube of these outlines; None if they are not those of one whole cube."""
        options = self._options
        if any(one.blob.is_cut for one in seen):
            return None
        fit = fit_cube(
            [(one.blob, one.image.view) for one in seen],
            place,
            table_m=seen[0].image.table_m,
            edge_m=options.edge_m,
            edge_spread_m=options.edge_spread_m,
            is_free=is_free,
        )
        if fit is None or fit.edge_spreads > MOST_SPREADS:
            return None
        fits = all(
            misfit <= worst_misfit_px(one.blob)
            for one, misfit in zip(seen, fit.misfits_px, strict=True)
        )
        return fit if fits else None

    def _whole(self, colour: str, seen: Sequence[_ColouredRegion], fit: CubeFit) -> LocatedObject:
        x, y, yaw, edge = fit.parameters[:4].tolist()
        is_free = len(fit.parameters) == 5
        bottom = float(fit.parameters[4]) if is_free else seen[0].image.table_m
        centre = np.zeros((3, len(fit.parameters)))  # derivatives of the centre
        centre[0, 0] = centre[1, 1] = 1.0
        centre[2, 3:] = (0.5, 1.0)[: len(fit.parameters) - 3]
        spread_m = float(np.sqrt(np.linalg.eigvalsh(centre @ fit.covariance @ centre.T)[-1]))
        spread_m *= max(1.0, max(fit.misfits_px) / PIXEL_PX)
        return LocatedObject(
            label="cube",
            colour=colour,
            position_m=np.array([x, y, bottom + edge / 2]),
            yaw_rad=float((yaw + _QUARTER / 2) % _QUARTER - _QUARTER / 2),
            symmetry_rad=_QUARTER,
            size_m=np.full(3, edge),
            uncertainty_m=max(_FLOOR_M, _P95 * spread_m),
            **_evidence(seen),
            is_height_assumed=len(seen) == 1,
        )

    def _hidden(self, colour: str, group: Sequence[_ColouredRegion]) -> LocatedObject | None:
        """An object of which no outline is whole; None if one picture alone shows too little of
        it.
        """
        edge = self._options.edge_m
        meeting = _meeting(group)
        if meeting is None and not _has_size(group[0], edge):
            return None
        return LocatedObject(
            label="cube",
            colour=colour,
            position_m=group[0].place_m if meeting is None else meeting,
            size_m=np.full(3, edge),
            uncertainty_m=(_ALONE if meeting is None else _HIDDEN) * edge,
            **_evidence(group),
            is_whole=False,
            is_height_assumed=meeting is None,
        )


def _doubt_m(found: Iterable[tuple[Sequence[_ColouredRegion], LocatedObject]]) -> float:
    """How far from its calibration a camera is: the median distance of the places that two cameras
    tell of one whole object, 0 where one cube fits both outlines; 0 if they see none together.

    Which camera it is cannot be known, so it is the doubt of all objects.
    """
    apart_m = []
    for group, one in found:
        clear = [seen for seen in group if seen.is_clear and not seen.is_beside]
        if len(clear) > 1:
            bottom_m = float(one.position_m[2] - one.size_m[2] / 2) - clear[0].image.table_m
            # outlines that meet inside the table contradict each other
            is_agreed = one.is_whole and len(one.cameras) > 1 and bottom_m > -_ON_TABLE_M
            off_m = float(np.linalg.norm(clear[0].place_m - clear[1].place_m))
            apart_m.append(0.0 if is_agreed else off_m)
    return _ELSEWHERE * float(np.percentile(apart_m, 50, method="higher")) if apart_m else 0.0


def _choices(group: Sequence[_ColouredRegion]) -> Iterator[Sequence[_ColouredRegion]]:
    """Regions to be tried as outlines of one cube: all, then each clear one whose place the other
    pictures do not contradict.
    """
    if len(group) > 1:
        yield group
    for seen in group:
        others = [other for other in group if other is not seen]
        agree = all(_off_m(other, seen.place_m) <= MEET_M for other in others)
        if seen.is_clear and not seen.is_beside and agree:
            yield (seen,)


def _quality(seen: _ColouredRegion) -> tuple[bool, int]:
    """Order of regions: those seen clearly first, then the large ones."""
    return not seen.is_clear, -seen.blob.area_px


def _apart_m(one: _ColouredRegion, other: _ColouredRegion) -> float:
    """Distance between the lines of sight of two regions where they meet; infinite if they do
    not.
    """
    meeting = ray_through(one.image.view, one.blob.centre).meeting(
        ray_through(other.image.view, other.blob.centre)
    )
    return np.inf if meeting is None else meeting[1]


def _off_m(seen: _ColouredRegion, place_m: F64) -> float:
    """Distance of a place (3,) from the line of sight of a region."""
    ray = ray_through(seen.image.view, seen.blob.centre)
    return float(np.linalg.norm(np.cross(ray.direction, place_m - ray.origin)))


def _meeting(group: Sequence[_ColouredRegion]) -> F64 | None:
    """Point (3,) where the lines of sight of the first two regions meet; None for one."""
    if len(group) < 2:
        return None
    rays = [ray_through(seen.image.view, seen.blob.centre) for seen in group[:2]]
    meeting = rays[0].meeting(rays[1])
    return None if meeting is None else meeting[0]


def _has_size(seen: _ColouredRegion, edge_m: float) -> bool:
    """True if a region is about as large as a cube at its place, or a good part of one."""
    view = seen.image.view
    distance_m = float(np.linalg.norm(seen.place_m - view.T_base_camera[:3, 3]))
    usual_px = float(view.intrinsics[0, 0]) * edge_m / distance_m
    return _LEAST_SIZE <= float(np.sqrt(seen.blob.area_px)) / usual_px <= _MOST_SIZE


def _is_beside(blob: Blob, others: Mask) -> bool:
    """True if pixels of other colours (H, W) adjoin a region."""
    columns, rows = (blob.pixels - 0.5).astype(np.intp).T
    touched = 0
    for down, right in ((-_RING_PX, 0), (_RING_PX, 0), (0, -_RING_PX), (0, _RING_PX)):
        moved_rows, moved_columns = rows + down, columns + right
        height, width = others.shape
        inside = (moved_rows >= 0) & (moved_rows < height) & (moved_columns >= 0)
        inside &= moved_columns < width
        touched += int(others[moved_rows[inside], moved_columns[inside]].sum())
    around = 4.0 * float(np.sqrt(blob.area_px)) * _RING_PX
    return touched > _BESIDE * around


def _evidence(group: Sequence[_ColouredRegion]) -> _Evidence:
    frames = [seen.image.frame for seen in group]
    return {
        "cameras": tuple(frame.camera for frame in frames),
        "seen_at_ns": min(frame.stamp_ns for frame in frames),
    }
