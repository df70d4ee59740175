"""Resizing of images with a constant aspect ratio, and of their intrinsics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Size = tuple[int, int]


@dataclass(frozen=True, kw_only=True, slots=True)
class Fit:
    """A part of the source image, scaled and placed in the target image; the rest is black.

    Attributes:
        source: width and height of the source images [px].
        size: width and height of the target images [px].
        box: left, upper, right and lower edge of the part [px of the source, pixel centres at
            integers + 0.5].
        scaled: width and height of that part in the target [px].
        offset: its left and upper edge in the target [px].
    """

    source: Size
    size: Size
    box: tuple[float, float, float, float]
    scaled: Size
    offset: tuple[int, int]

    def apply(self, image: U8) -> U8:
        """uint8 (h, w, 3) of `source` size -> uint8 (H, W, 3) of `size`; bilinear with
        antialiasing.

        Returns the image itself if nothing changes.
        """
        if self.source == self.size:
            return image
        part = Image.fromarray(image).resize(self.scaled, Image.Resampling.BILINEAR, box=self.box)
        if self.scaled == self.size:
            return np.asarray(part)
        whole = np.zeros((self.size[1], self.size[0], 3), dtype=np.uint8)
        (x, y), (width, height) = self.offset, self.scaled
        whole[y : y + height, x : x + width] = np.asarray(part)
        return whole

    def apply_depth(self, depth_m: F32) -> F32:
        """float32 (h, w) of `source` size -> float32 (H, W) of `size`; the nearest value, NaN in
        the bars.
        """
        if self.source == self.size:
            return depth_m
        part = Image.fromarray(depth_m).resize(self.scaled, Image.Resampling.NEAREST, box=self.box)
        whole = np.full((self.size[1], self.size[0]), np.nan, dtype=np.float32)
        (x, y), (width, height) = self.offset, self.scaled
        whole[y : y + height, x : x + width] = np.asarray(part)
        return whole

    def to_intrinsics(self, intrinsics: F64) -> F64:
        """float64 (3, 3) [px] of the source -> of the target; pixel centres at integers + 0.5 in
        both.
        """
        left, upper, right, lower = self.box
        x, y = self.scaled[0] / (right - left), self.scaled[1] / (lower - upper)
        to_target = np.array(
            [[x, 0.0, self.offset[0] - x * left], [0.0, y, self.offset[1] - y * upper], [0, 0, 1]]
        )
        fitted: F64 = to_target @ intrinsics
        return fitted


def unchanged(source: Size) -> Fit:
    """Keep images unchanged."""
    return Fit(
        source=source,
        size=source,
        box=(0.0, 0.0, float(source[0]), float(source[1])),
        scaled=source,
        offset=(0, 0),
    )


def fit(source: Size, size: Size, how: Literal["letterbox", "crop"]) -> Fit:
    """Fit the whole image with bars ("letterbox"), or the largest central part that fills the
    target ("crop").
    """
    width, height = source
    across, down = size[0] / width, size[1] / height
    if how == "crop":
        scale = max(across, down)
        left, upper = (
            max(0.0, (width - size[0] / scale) / 2),
            max(0.0, (height - size[1] / scale) / 2),
        )
        box = (left, upper, width - left, height - upper)
        return Fit(source=source, size=size, box=box, scaled=size, offset=(0, 0))
    scale = min(across, down)
    scaled = (
        min(size[0], max(1, round(width * scale))),
        min(size[1], max(1, round(height * scale))),
    )
    offset = ((size[0] - scaled[0]) // 2, (size[1] - scaled[1]) // 2)
    return Fit(
        source=source,
        size=size,
        box=(0.0, 0.0, float(width), float(height)),
        scaled=scaled,
        offset=offset,
    )
