"""Colours visible in an encoded image."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from rn_standard.sight import segmentation


def visible_colours(encoded: bytes) -> list[str]:
    """Colour words of the visible colours, in the order of `segmentation.HUES_DEG`."""
    with Image.open(io.BytesIO(encoded)) as opened:
        return segmentation.visible_colours(np.asarray(opened.convert("RGB")))
