"""Image preprocessing of pi0: 224 x 224, same aspect ratio, black bars, resized as in the
checkpoint's own code.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_vla.letterbox import U8, Flip, fit_antialiased, fitted, flip_image

F32 = NDArray[np.float32]
Resize = Literal["antialiased", "plain"]


def _sample_axis(size: int, target: int) -> tuple[NDArray[np.intp], NDArray[np.intp], F32]:
    """Lower and upper index, and the weight of the upper one, for half-pixel-centred bilinear
    sampling.
    """
    position = np.maximum(
        (np.arange(target, dtype=np.float32) + 0.5) * np.float32(size / target) - 0.5, 0.0
    )
    lower = np.minimum(np.floor(position).astype(np.intp), size - 1)
    return lower, np.minimum(lower + 1, size - 1), (position - lower).astype(np.float32)


def _mix(first: NDArray[np.generic], second: NDArray[np.generic], weight: F32) -> F32:
    """first + weight (second - first) in float32."""
    base = first.astype(np.float32)
    out = second.astype(np.float32)
    out -= base
    out *= weight
    out += base
    return out


def resize_plain(image: U8, side: int) -> F32:
    """Resize uint8 (H, W, 3) to float32 (side, side, 3) in 0..255, bilinear without antialiasing,
    centred on black.

    Source: LeRobot's pi0, resize_with_pad_torch (interpolation with align_corners off and antialias
    off).
    """
    height, width = image.shape[:2]
    if (height, width) == (side, side):
        return image.astype(np.float32)
    inner_height, inner_width, top, left = fitted(height, width, (side, side))
    inner_height, inner_width = max(1, inner_height), max(1, inner_width)
    top_rows, bottom_rows, row_weight = _sample_axis(height, inner_height)
    left_columns, right_columns, column_weight = _sample_axis(width, inner_width)
    upper, lower = (
        _mix(rows[:, left_columns], rows[:, right_columns], column_weight[None, :, None])
        for rows in (image[top_rows], image[bottom_rows])
    )
    pixels = _mix(upper, lower, row_weight[:, None, None])
    canvas = np.zeros((side, side, 3), dtype=np.float32)
    canvas[top : top + inner_height, left : left + inner_width] = pixels
    return canvas


def to_pixels(image: U8, *, side: int, resize: Resize, flip: Flip) -> F32:
    """Convert uint8 RGB (H, W, 3) to float32 (3, side, side) in -1..1."""
    turned = flip_image(image, flip)
    square = (
        resize_plain(turned, side) if resize == "plain" else fit_antialiased(turned, (side, side))
    )
    pixels = np.empty((3, side, side), dtype=np.float32)
    np.divide(square.transpose(2, 0, 1), np.float32(255.0), out=pixels)
    pixels *= 2.0
    pixels -= 1.0
    return pixels
