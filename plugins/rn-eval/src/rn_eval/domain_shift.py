"""Domain shift of the suite "cubes": different camera pose, light, table or sensor noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rn_simulation.cubes import TABLE_RGBA
from rn_simulation.pinhole import PinholeCamera

U8 = NDArray[np.uint8]

Shift: TypeAlias = Literal["none", "camera", "light", "table", "noise"]
CAMERA_SHIFT_M = 0.02
"""Displacement of a camera next to the table [m]; its direction differs per episode."""
LIGHT_GAIN = (0.80, 0.72, 0.60)
"""Gains of red, green and blue: darker and warmer."""
TABLE_CONTRAST, TABLE_GRAIN_PX = 0.15, 4
"""Standard deviation of the brightness of a textured table, and the size of its spots at 224 px."""
NOISE_LEVELS = 8.0
"""Standard deviation of a pixel value, of 255."""
_TABLE_TOLERANCE = 0.03
_DRAW = 0x73686674


class DomainShift:
    """One kind of shift in one episode; reproducible by the seed.

    Args:
        kind: the kind of shift.
        seed: seed of the episode.
    """

    def __init__(self, kind: Shift, seed: int) -> None:
        self.kind = kind
        self._random = np.random.default_rng([_DRAW, seed])
        self._texture_seed = int(self._random.integers(2**31))

    def cameras(self, cameras: Sequence[PinholeCamera]) -> tuple[PinholeCamera, ...]:
        """Shifted cameras; wrist cameras stay. The policy uses the original poses."""
        if self.kind != "camera":
            return tuple(cameras)
        way = self._random.normal(size=3)
        offset_m = CAMERA_SHIFT_M * way / np.linalg.norm(way)
        return tuple(camera.displaced(offset_m) for camera in cameras)

    def image(self, image: U8) -> U8:
        """Simulated sensor output for a rendered image, uint8 (H, W, 3) RGB."""
        match self.kind:
            case "light":
                return _pixels(image * np.array(LIGHT_GAIN))
            case "table":
                return _pixels(image * self._texture(image)[:, :, None])
            case "noise":
                return _pixels(image + self._random.normal(0.0, NOISE_LEVELS, image.shape))
            case _:
                return image

    def _texture(self, image: U8) -> NDArray[np.float64]:
        """Brightness of each pixel, (H, W): spots on the table, 1 elsewhere."""
        height, width = image.shape[:2]
        grain = max(1, round(TABLE_GRAIN_PX * height / 224))
        spots = np.random.default_rng(self._texture_seed).normal(
            1.0, TABLE_CONTRAST, (height // grain + 1, width // grain + 1)
        )
        spread = np.kron(spots, np.ones((grain, grain)))[:height, :width]
        return np.where(_shows_table(image), spread, 1.0)


def _shows_table(image: U8) -> NDArray[np.bool_]:
    """True for pixels with the table's hue, (H, W); nothing else in the cell has it."""
    shares = image / np.maximum(image.sum(axis=2, keepdims=True, dtype=np.float64), 1.0)
    table = np.array(TABLE_RGBA[:3]) / sum(TABLE_RGBA[:3])
    is_hue: NDArray[np.bool_] = np.abs(shares - table).max(axis=2) < _TABLE_TOLERANCE / 3
    return is_hue


def _pixels(values: NDArray[np.float64]) -> U8:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
