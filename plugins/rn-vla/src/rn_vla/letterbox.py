"""Images fitted to a policy's input: rotated, with the same aspect ratio and black bars."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

U8 = NDArray[np.uint8]
Flip = Literal["none", "rotate-180", "mirror"]


def flip_image(image: U8, flip: Flip) -> U8:
    """Convert an upright image (H, W, 3) to the orientation of the training data ("mirror" swaps
    left and right).
    """
    if flip == "rotate-180":
        return image[::-1, ::-1]
    return image[:, ::-1] if flip == "mirror" else image


def fitted(height: int, width: int, into: tuple[int, int]) -> tuple[int, int, int, int]:
    """Height and width inside the target, and the top and left margin. Source: openpi and LeRobot.

    Args:
        height, width: of the picture [px].
        into: height and width of the target [px].
    """
    ratio = max(height / into[0], width / into[1])
    inner_height, inner_width = int(height / ratio), int(width / ratio)
    return inner_height, inner_width, (into[0] - inner_height) // 2, (into[1] - inner_width) // 2


def fit_antialiased(image: U8, into: tuple[int, int]) -> U8:
    """Resize uint8 (H, W, 3) to uint8 (*into, 3), bilinear with antialiasing when shrinking,
    centred on black.

    Args:
        into: height and width [px].

    Source: openpi's client, image_tools.resize_with_pad (PIL).
    """
    height, width = image.shape[:2]
    if (height, width) == into:
        return image
    inner_height, inner_width, top, left = fitted(height, width, into)
    resized = Image.fromarray(np.ascontiguousarray(image)).resize(
        (max(1, inner_width), max(1, inner_height)), resample=Image.Resampling.BILINEAR
    )
    canvas = np.zeros((*into, 3), dtype=np.uint8)
    canvas[top : top + resized.height, left : left + resized.width] = np.asarray(resized)
    return canvas
