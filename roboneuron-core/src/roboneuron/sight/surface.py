"""Surfaces in a depth image: places of pixels, the table's plane, and what stands out of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import CalibratedImage
from roboneuron.sight.segmentation import Mask, regions

F32 = NDArray[np.float32]

_STEP = 4
"""Every so many rows and columns give the plane."""
_LEAST_PLANE = 150
"""Points below which a picture shows no table."""
_ROUNDS = 4
_JUMP_M, _JUMP_STEPS = 0.012, 4.0
"""Depths of neighbouring pixels that differ by more are of two surfaces: absolute, and in widths of
a pixel there; or by more than `_NOISES` deviations of the depth.
"""
_LEAST_PX = 25
"""Regions below are noise."""
_REACH_PX = 0.15
"""How far a surface reaches beyond the middles of its outermost pixels, of which the farthest
count.
"""
_GRAZING = 0.05
_NOISES, _HOLE_PX = 6.0, 12
"""See `_JUMP_M`; and the widest hole across which a neighbour is looked for: stereo cameras measure
nothing beside the edge of a near object.
"""
_SIDES = ((0, 1), (0, -1), (1, 0), (-1, 0))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TablePlane:
    """The plane z = slope @ (x, y) + height in the base frame.

    Attributes:
        slope: float64 (2,).
        height_m: at the base.
        noise_m: standard deviation of the measured points about it.
        is_seen: fitted to the picture; otherwise the configured height is taken.
    """

    slope: F64
    height_m: float
    noise_m: float
    is_seen: bool

    def at(self, places_m: NDArray[np.floating]) -> NDArray[np.floating]:
        """Its height [m] at places (..., 2 or more)."""
        flat: NDArray[np.floating] = places_m[..., :2] @ self.slope.astype(places_m.dtype)
        return flat + places_m.dtype.type(self.height_m)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class DepthBlob:
    """A connected surface that stands out of the table.

    Attributes:
        box_px: float64 (4,), left, upper, right and lower edge in the picture.
        points_m: float64 (n, 3), base frame.
        outline_m: float64 (m, 2), edges of its outermost pixels, seen from above.
        heights_m: float64 (n,), above the table.
        depth_m: median distance from the camera along its axis.
        nearest_m: least distance likewise.
        hidden: part of its outline beside which something nearer is, or a wide hole, 0..1.
        is_cut: it touches the edge of the picture.
    """

    box_px: F64
    points_m: F64
    outline_m: F64
    heights_m: F64
    depth_m: float
    nearest_m: float
    hidden: float
    is_cut: bool


def places_of(image: CalibratedImage, depth_m: F32) -> F32:
    """Places (H, W, 3) in the base frame of the pixels of a picture [m], NaN in holes."""
    camera = image.view.intrinsics
    height, width = depth_m.shape
    columns = ((np.arange(width) + 0.5 - camera[0, 2]) / camera[0, 0]).astype(np.float32)
    rows = ((np.arange(height) + 0.5 - camera[1, 2]) / camera[1, 1]).astype(np.float32)
    pose = image.T_base_camera.astype(np.float32)
    places = np.empty((height, width, 3), dtype=np.float32)
    for axis in range(3):
        ray = pose[axis, 0] * columns[None, :] + pose[axis, 1] * rows[:, None] + pose[axis, 2]
        places[..., axis] = ray * depth_m + pose[axis, 3]
    return places


def table_of(places_m: F32, expected_m: float, slack_m: float) -> TablePlane:
    """The table in a picture.

    Args:
        places_m: (H, W, 3), base frame.
        expected_m: its configured height.
        slack_m: it is at most so far from there.
    """
    points = places_m[::_STEP, ::_STEP].reshape(-1, 3).astype(np.float64)
    points = points[np.abs(points[:, 2] - expected_m) <= slack_m]
    solution = np.array([0.0, 0.0, expected_m])
    bound = slack_m
    for _ in range(_ROUNDS):
        off = points[:, 2] - points[:, :2] @ solution[:2] - solution[2]
        kept = points[np.abs(off) <= bound]
        if len(kept) < _LEAST_PLANE:
            return TablePlane(slope=np.zeros(2), height_m=expected_m, noise_m=0.0, is_seen=False)
        system = np.column_stack([kept[:, :2], np.ones(len(kept))])
        solution = np.linalg.lstsq(system, kept[:, 2], rcond=None)[0]
        spread = 1.4826 * float(np.median(np.abs(kept[:, 2] - system @ solution)))
        bound = max(0.002, 3.0 * spread)
    return TablePlane(slope=solution[:2], height_m=float(solution[2]), noise_m=spread, is_seen=True)


def blobs_above(
    image: CalibratedImage, depth_m: F32, places_m: F32, table: TablePlane, least_m: float
) -> list[DepthBlob]:
    """The surfaces that are more than `least_m` above the table.

    Something that touches another thing of the same height is one surface with it.
    """
    heights = places_m[..., 2] - table.at(places_m)
    width_px = depth_m / np.float32(image.view.intrinsics[0, 0])
    least_jump_m = max(_JUMP_M, _NOISES * table.noise_m)
    jump = np.maximum(np.float32(least_jump_m), np.float32(_JUMP_STEPS) * width_px)
    is_above = heights > least_m  # false in holes
    covered = np.zeros(depth_m.shape, dtype=bool)
    for first, second in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        step = depth_m[first] - depth_m[second]
        covered[first] |= step > jump[first]
        covered[second] |= -step > jump[second]
    found = []
    for runs in regions(is_above & ~covered):
        if sum(end - start for _, start, end in runs) >= _LEAST_PX:
            found.append(_blob(image, depth_m, places_m, heights, jump, runs))
    return found


def _blob(
    image: CalibratedImage,
    depth_m: F32,
    places_m: F32,
    heights: F32,
    jump: F32,
    runs: list[tuple[int, int, int]],
) -> DepthBlob:
    columns = np.concatenate([np.arange(start, end) for _, start, end in runs])
    rows = np.repeat([row for row, _, _ in runs], [end - start for _, start, end in runs])
    top, left = rows.min(), columns.min()
    own = np.zeros((rows.max() - top + 3, columns.max() - left + 3), dtype=bool)
    own[rows - top + 1, columns - left + 1] = True
    here = depth_m[rows, columns]
    height, width = depth_m.shape
    is_edge = np.zeros(len(rows), dtype=bool)
    is_hidden = np.zeros(len(rows), dtype=bool)
    for down, right in _SIDES:
        is_outer = ~own[rows - top + 1 + down, columns - left + 1 + right]
        is_edge |= is_outer
        at = (rows[is_outer], columns[is_outer])
        is_hidden[is_outer] |= _is_behind(depth_m, at, (down, right), jump[at])
    is_cut = bool(
        min(rows.min(), columns.min()) == 0
        or rows.max() == height - 1
        or columns.max() == width - 1
    )
    points = places_m[rows, columns].astype(np.float64)
    own_heights = heights[rows, columns].astype(np.float64)
    return DepthBlob(
        box_px=np.array([left, top, columns.max() + 1, rows.max() + 1], dtype=np.float64),
        points_m=points,
        outline_m=_outline(image, points[is_edge], own_heights, rows, columns, is_edge),
        heights_m=own_heights,
        depth_m=float(np.median(here)),
        nearest_m=float(here.min()),
        hidden=float(is_hidden.sum() / max(1, is_edge.sum())),
        is_cut=is_cut,
    )


def _is_behind(
    depth_m: F32,
    at: tuple[NDArray[np.intp], NDArray[np.intp]],
    side: tuple[int, int],
    jump: F32,
) -> Mask:
    """True for pixels (n,) beside which something nearer is, or nothing is measured.

    Two measured pixels are looked at: the one beside something nearer belongs to no surface.
    """
    here = depth_m[at]
    measured = np.zeros(len(here), dtype=np.intp)
    is_behind = np.zeros(len(here), dtype=bool)
    for step in range(1, _HOLE_PX + 1):
        rows = np.clip(at[0] + step * side[0], 0, depth_m.shape[0] - 1)
        columns = np.clip(at[1] + step * side[1], 0, depth_m.shape[1] - 1)
        beside = depth_m[rows, columns]
        is_behind |= (measured < 2) & (here - beside > jump)  # false in holes
        measured += np.isfinite(beside)
    is_behind |= measured == 0
    return is_behind


def _outline(
    image: CalibratedImage,
    edge_m: F64,
    heights: F64,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    is_edge: Mask,
) -> F64:
    """Where the outermost pixels end, seen from above (m, 2): their corners on level surfaces, and
    their middles on steep ones, which are seen edge-on from above.
    """
    is_top = heights[is_edge] > top_of(heights) - LEVEL_M
    flat = edge_m[is_top]
    view = image.view
    turned = view.T_base_camera[:3, :3] @ np.linalg.inv(view.intrinsics)
    origin = view.T_base_camera[:3, 3]
    middles = np.column_stack([columns, rows])[is_edge][is_top] + 0.5
    found = [edge_m[:, :2]]
    for off in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        rays = (
            np.column_stack([middles + _REACH_PX * np.array(off), np.ones(len(middles))]) @ turned.T
        )
        is_steep = np.abs(rays[:, 2]) > _GRAZING  # others meet a level surface anywhere
        along = (flat[is_steep, 2] - origin[2]) / rays[is_steep, 2]
        found.append(origin[:2] + along[:, None] * rays[is_steep, :2])
    return np.concatenate(found)


LEVEL_M = 0.004
"""Points so little below the highest are of its level top."""


def top_of(heights: F64) -> float:
    """Height of the top of a surface, without its highest points, which may be noise."""
    return float(np.percentile(heights, 98))
