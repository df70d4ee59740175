"""Segmentation of coloured objects in an image: hue ranges and connected regions, numpy only."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract.arrays import F64

__all__ = ["HUES_DEG", "visible_colours"]
"""Names that other distributions may use."""

Mask = NDArray[np.bool_]

HUES_DEG = {
    "red": (-14.0, 13.0),
    "orange": (16.0, 37.0),
    "yellow": (41.0, 68.0),
    "green": (85.0, 165.0),
    "blue": (200.0, 250.0),
    "purple": (262.0, 315.0),
}
"""Lowest and highest hue of each colour [deg]; the gaps belong to none."""
LEAST_SATURATION = 0.45
LEAST_VALUE = 0.15
"""Limits below which pixels are grey, pale or dark and have no colour."""
LEAST_AREA_PX = 16
"""Area below which regions are noise."""
LEAST_FILL = 0.45
"""Smallest fraction of its bounding box that a compact region fills: a cube's outline fills at
least half from any direction.
"""

_TINTED, _TINT_SATURATION, _TINT_HUE_DEG = 0.85, 0.25, 25.0
"""A picture is tinted if so many of its pixels are at least so saturated and of about one hue: in
white light walls, robots and most tables are not.
"""
_SPARSE = 4
"""Step at which pixels are taken to judge the light."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Blob:
    """A connected region of one colour.

    Attributes:
        pixels: float64 (n, 2), u v of the pixel centres.
        is_cut: True if it touches the edge of the image, so part of it may be outside.
    """

    pixels: F64
    is_cut: bool

    @property
    def area_px(self) -> int:
        """Number of pixels."""
        return len(self.pixels)

    @property
    def centre(self) -> F64:
        """Centroid (2,) [px]."""
        centre: F64 = self.pixels.mean(axis=0)
        return centre


def tint_of(image: NDArray[np.uint8]) -> F64 | None:
    """Colour (3,) of the light in `image` (H, W, 3) RGB, its brightest channel 1, by which dividing
    makes the usual pixel grey; None if the light is about white.
    """
    sparse = np.ascontiguousarray(image[::_SPARSE, ::_SPARSE])
    bright = int(np.count_nonzero(sparse.max(axis=2) >= LEAST_VALUE * 255))
    vivid, hues = _vivid_hues(sparse, _TINT_SATURATION)
    if not bright or len(hues) < _TINTED * bright:
        return None
    usual: F64 = np.median(sparse[vivid].astype(np.float64), axis=0)
    _, usual_deg = _vivid_hues(usual.astype(np.uint8).reshape(1, 1, 3), _TINT_SATURATION)
    apart_deg = np.abs((hues[:, np.newaxis] - usual_deg + 180.0) % 360.0 - 180.0)
    if np.count_nonzero(apart_deg <= _TINT_HUE_DEG) < _TINTED * bright:
        return None  # also where the usual pixel is grey
    tint: F64 = np.maximum(usual, 1.0) / usual.max()
    return tint


def balanced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """`image` (H, W, 3) RGB as in white light, see `tint_of`."""
    tint = tint_of(image)
    return image if tint is None else np.minimum(image / tint, 255.0).astype(np.uint8)


def _vivid_hues(image: NDArray[np.uint8], saturation: float = LEAST_SATURATION) -> tuple[Mask, F64]:
    """Pixels of `image` that are at least so saturated and bright enough to have a colour, and
    their hues [deg], row by row.
    """
    channels = [image[:, :, i] for i in range(3)]
    high = np.maximum(np.maximum(channels[0], channels[1]), channels[2])
    spread = high - np.minimum(np.minimum(channels[0], channels[1]), channels[2])
    vivid = (spread >= saturation * high) & (high >= LEAST_VALUE * 255) & (spread > 0)
    red, green, blue = image[vivid].astype(np.float64).T
    top, width = high[vivid].astype(np.float64), spread[vivid].astype(np.float64)
    sector = np.select(
        [top == red, top == green],
        [(green - blue) / width, 2.0 + (blue - red) / width],
        4.0 + (red - green) / width,
    )
    hues: F64 = 60.0 * sector % 360.0
    return vivid, hues


def colour_masks(
    image: NDArray[np.uint8], colours: Iterable[str] = HUES_DEG
) -> Iterator[tuple[str, Mask]]:
    """Pixels of `image` (H, W, 3) RGB whose hue is that of each colour, keys of HUES_DEG."""
    vivid, hues = _vivid_hues(image)
    for colour in colours:
        low, up = HUES_DEG[colour]
        mask = np.zeros(vivid.shape, dtype=np.bool_)
        mask[vivid] = (hues - low) % 360.0 <= up - low
        yield colour, mask


def colour_mask(image: NDArray[np.uint8], colour: str) -> Mask:
    """The mask of one colour, see `colour_masks`."""
    return next(mask for _, mask in colour_masks(image, (colour,)))


def _runs(mask: Mask) -> list[tuple[int, int, int]]:
    """Horizontal runs of True, row by row: (row, first column, column after the last)."""
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, starts = np.nonzero(edges == 1)
    _, ends = np.nonzero(edges == -1)
    return list(zip(rows.tolist(), starts.tolist(), ends.tolist(), strict=True))


def regions(mask: Mask) -> list[list[tuple[int, int, int]]]:
    """Connected regions (four neighbours) as lists of horizontal runs (row, first column, column
    after the last).
    """
    runs = _runs(mask)
    parent = list(range(len(runs)))

    def find(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    above: list[int] = []
    current: list[int] = []
    row = -2
    for i, (r, start, end) in enumerate(runs):
        if r != row:
            above = current if r == row + 1 else []
            current, row = [], r
        for j in above:
            if runs[j][1] < end and start < runs[j][2]:
                parent[find(j)] = find(i)
        current.append(i)
    grouped: dict[int, list[tuple[int, int, int]]] = {}
    for i, run in enumerate(runs):
        grouped.setdefault(find(i), []).append(run)
    return list(grouped.values())


def blobs_of(mask: Mask) -> list[Blob]:
    """The compact regions of a mask (H, W), the largest first."""
    found: list[tuple[int, list[tuple[int, int, int]]]] = []
    for region in regions(mask):
        area = sum(end - start for _, start, end in region)
        box = (region[-1][0] - region[0][0] + 1) * (
            max(r[2] for r in region) - min(r[1] for r in region)
        )
        if area >= LEAST_AREA_PX and area >= LEAST_FILL * box:
            found.append((area, region))
    found.sort(key=lambda sized: -sized[0])  # stable: of equal ones the first stays first
    return [_blob(region, mask.shape) for _, region in found]


def find_blob(image: NDArray[np.uint8], colour: str) -> Blob | None:
    """The largest compact region of `colour` in `image` (H, W, 3) RGB, or None."""
    return next(iter(blobs_of(colour_mask(image, colour))), None)


def _blob(region: list[tuple[int, int, int]], shape: tuple[int, ...]) -> Blob:
    height, width = shape
    columns = np.concatenate([np.arange(start, end) for _, start, end in region])
    rows = np.repeat([row for row, _, _ in region], [end - start for _, start, end in region])
    is_cut = bool(
        rows.min() == 0
        or columns.min() == 0
        or rows.max() == height - 1
        or columns.max() == width - 1
    )
    return Blob(pixels=np.column_stack([columns, rows]) + 0.5, is_cut=is_cut)


def visible_colours(image: NDArray[np.uint8]) -> list[str]:
    """Names of the colours with a compact region in `image`."""
    return [colour for colour, mask in colour_masks(image) if blobs_of(mask)]
