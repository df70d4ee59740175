"""Light and background of rendered images, the same in every engine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LIGHT_DIRECTION = (1.2, 0.8, 2.5)
"""Direction towards the light, in the base frame."""
AMBIENT = 0.55
DIFFUSE = 0.45
_BACKDROP_TOP_RGB = (196, 205, 216)
_BACKDROP_BOTTOM_RGB = (122, 130, 142)


def backdrop(height: int) -> NDArray[np.uint8]:
    """Background colour by row, (height, 1, 3); rendering a floor instead would cost 10 ms per
    image.
    """
    blend = np.linspace(0.0, 1.0, height)[:, None, None]
    rows = (1.0 - blend) * np.array(_BACKDROP_TOP_RGB) + blend * np.array(_BACKDROP_BOTTOM_RGB)
    colours: NDArray[np.uint8] = rows.astype(np.uint8)
    return colours
