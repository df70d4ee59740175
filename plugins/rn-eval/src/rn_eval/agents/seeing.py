"""Colours visible in an image: patches of one saturated hue, large enough to be a cube."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

HUES = {
    "red": (350.0, 12.0),
    "orange": (18.0, 38.0),
    "yellow": (44.0, 62.0),
    "green": (110.0, 160.0),
    "blue": (215.0, 250.0),
    "purple": (275.0, 305.0),
}
"""Lowest and highest hue [degrees] of a colour word; red wraps around zero."""
_LEAST_SATURATION, _LEAST_VALUE = 0.55, 0.2
_LEAST_SHARE = 6e-4
"""Minimum share of the image's pixels: half of a cube's face at the far edge of the table."""


def visible_colours(encoded: bytes) -> list[str]:
    """Colour words of the visible colours, in the order of `HUES`."""
    with Image.open(io.BytesIO(encoded)) as opened:
        hsv = np.asarray(opened.convert("RGB").convert("HSV"), dtype=np.float64)
    hue, saturation, value = hsv[..., 0] * 360 / 255, hsv[..., 1] / 255, hsv[..., 2] / 255
    strong = (saturation >= _LEAST_SATURATION) & (value >= _LEAST_VALUE)
    found: list[str] = []
    for name, (low, high) in HUES.items():
        within = (hue >= low) & (hue <= high) if low < high else (hue >= low) | (hue <= high)
        if float((within & strong).mean()) >= _LEAST_SHARE:
            found.append(name)
    return found
