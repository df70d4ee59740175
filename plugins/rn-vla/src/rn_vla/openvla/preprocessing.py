"""From a camera image to the model's pixels, without torchvision: PIL resizes, a table per channel normalises."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
ImageStep = Literal["rotate_180", "jpeg_95", "resize_lanczos", "center_crop_90"]

_CROP_AREA = 0.9


@dataclass(frozen=True, kw_only=True, slots=True)
class TowerPixels:
    """How one vision tower wants its pixels: mean and standard deviation of R, G, B, on values in [0, 1]."""

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


class Preprocessor:
    """Image (H, W, 3) -> float32 (3 * towers, size, size), as the checkpoint's processor would."""

    def __init__(self, *, size: int, towers: tuple[TowerPixels, ...], steps: tuple[ImageStep, ...] = ()) -> None:
        self._size = size
        self._steps = tuple(_STEPS[step] for step in steps)
        levels = np.arange(256, dtype=np.float32) / np.float32(255)
        self._tables = [
            (levels - np.float32(mean)) / np.float32(std)
            for tower in towers
            for mean, std in zip(tower.mean, tower.std, strict=True)
        ]

    def to_model_image(self, image: U8) -> U8:
        """Apply the configured image steps: what a served engine's own processor is to start from."""
        for step in self._steps:
            image = step(image, self._size)
        return np.ascontiguousarray(image)

    def to_pixels(self, image: U8) -> F32:
        """Resize to the square without keeping the aspect (bicubic, antialiased), scale, normalise per tower."""
        if image.shape[:2] != (self._size, self._size):
            image = np.asarray(Image.fromarray(image).resize((self._size, self._size), Image.Resampling.BICUBIC))
        planes = np.ascontiguousarray(image.transpose(2, 0, 1))
        pixels = np.empty((len(self._tables), self._size, self._size), dtype=np.float32)
        for channel, table in enumerate(self._tables):
            np.take(table, planes[channel % 3], out=pixels[channel], mode="clip")  # other modes copy once more
        return pixels


def _rotate_180(image: U8, size: int) -> U8:
    return image[::-1, ::-1]


def _jpeg_95(image: U8, size: int) -> U8:
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, format="JPEG", quality=95)
    return np.asarray(Image.open(buffer))


def _resize_lanczos(image: U8, size: int) -> U8:
    return np.asarray(Image.fromarray(np.ascontiguousarray(image)).resize((size, size), Image.Resampling.LANCZOS))


def _center_crop_90(image: U8, size: int) -> U8:
    """The middle 90 % of the area, bilinear at aligned corners, back to `size`.

    Source: tf.image.crop_and_resize and convert_image_dtype, as the LIBERO evaluation uses them.
    """
    side = np.sqrt(np.float32(_CROP_AREA))
    first, last = (1 - side) / 2, (1 + side) / 2
    unit = image.astype(np.float32) / np.float32(255)
    for axis in (0, 1):
        edge = image.shape[axis] - 1
        at = first * edge + np.arange(size, dtype=np.float32) * ((last - first) * edge / (size - 1))
        low = np.floor(at).astype(np.intp)
        high = np.minimum(low + 1, edge)
        weight = (at - low).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        unit = unit.take(low, axis=axis) * (1 - weight) + unit.take(high, axis=axis) * weight
    cropped: U8 = (np.clip(unit, 0.0, 1.0) * np.float32(255.5)).astype(np.uint8)
    return cropped


_STEPS: Mapping[str, Callable[[U8, int], U8]] = MappingProxyType(
    {
        "rotate_180": _rotate_180,
        "jpeg_95": _jpeg_95,
        "resize_lanczos": _resize_lanczos,
        "center_crop_90": _center_crop_90,
    }
)
