"""Conversion of a camera image to the model's pixels, without torchvision: PIL resizes, a table per
channel normalises.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import Image

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
ImageStep = Literal["rotate_180", "jpeg_95", "resize_lanczos", "center_crop_90"]

_CROP_AREA = 0.9
_LANCZOS_RADIUS = 3.0


@dataclass(frozen=True, kw_only=True, slots=True)
class TowerPixels:
    """Pixel normalisation of one vision tower: mean and standard deviation of R, G, B, on values in
    [0, 1].
    """

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


class Preprocessor:
    """Converts an image (H, W, 3) to float32 (3 * towers, size, size), like the checkpoint's
    processor.
    """

    def __init__(
        self, *, size: int, towers: tuple[TowerPixels, ...], steps: tuple[ImageStep, ...] = ()
    ) -> None:
        self._size = size
        self._steps = tuple(_STEPS[step] for step in steps)
        levels = np.arange(256, dtype=np.float32) / np.float32(255)
        self._tables = [
            (levels - np.float32(mean)) / np.float32(std)
            for tower in towers
            for mean, std in zip(tower.mean, tower.std, strict=True)
        ]

    def to_model_image(self, image: U8) -> U8:
        """Apply the configured image steps; the result is the input of a served engine's own
        processor.
        """
        for step in self._steps:
            image = step(image, self._size)
        return np.ascontiguousarray(image)

    def to_pixels(self, image: U8) -> F32:
        """Resize to the square without keeping the aspect ratio (bicubic, antialiased), scale,
        normalise per tower.
        """
        if image.shape[:2] != (self._size, self._size):
            image = np.asarray(
                Image.fromarray(image).resize((self._size, self._size), Image.Resampling.BICUBIC)
            )
        planes = np.ascontiguousarray(image.transpose(2, 0, 1))
        pixels = np.empty((len(self._tables), self._size, self._size), dtype=np.float32)
        for channel, table in enumerate(self._tables):
            # other modes copy once more
            np.take(table, planes[channel % 3], out=pixels[channel], mode="clip")
        return pixels


def _rotate_180(image: U8, size: int) -> U8:
    return image[::-1, ::-1]


def _jpeg_95(image: U8, size: int) -> U8:
    """Encode as JPEG and decode again, bit-identical with tf.image.encode_jpeg and
    tf.io.decode_image.

    TensorFlow decodes with the fast integer transform, PIL with the accurate one: 64 % of the
    values of a LIBERO image differ, by 1 on average and by up to 17.
    """
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(
        buffer, format="JPEG", quality=95, subsampling=2
    )
    decoded: U8 = simplejpeg.decode_jpeg(buffer.getvalue(), "RGB", fastdct=True, fastupsample=False)
    return decoded


def _resize_lanczos(image: U8, size: int) -> U8:
    """Resize in float32 and round once, while PIL rounds after each direction.

    Source: tf.image.resize(method="lanczos3", antialias=True), then tf.round, clip and cast.
    """
    height, width = image.shape[:2]
    rows = _lanczos(height, size) @ image.reshape(height, -1).astype(np.float32)
    turned = rows.reshape(size, width, -1).transpose(1, 0, 2).reshape(width, -1)
    columns = (_lanczos(width, size) @ turned).reshape(size, size, -1).transpose(1, 0, 2)
    return np.clip(np.round(columns), 0, 255).astype(np.uint8)


@functools.lru_cache(maxsize=8)
def _lanczos(given: int, wanted: int) -> F32:
    """Weights (wanted, given) of the Lanczos kernel with three lobes, antialiased; rows sum to
    1.
    """
    step = np.float32(given) / np.float32(wanted)
    widening = max(step, np.float32(1.0))
    centres = (np.arange(wanted, dtype=np.float32) + np.float32(0.5)) * step
    at = np.abs(
        (np.arange(given, dtype=np.float32)[None] + np.float32(0.5) - centres[:, None]) / widening
    )
    kernel = np.where(
        at <= _LANCZOS_RADIUS, np.sinc(at) * np.sinc(at / _LANCZOS_RADIUS), 0.0
    ).astype(np.float32)
    weights: F32 = kernel / kernel.sum(axis=1, keepdims=True)
    weights.setflags(write=False)
    return weights


def _center_crop_90(image: U8, size: int) -> U8:
    """Crop the middle 90 % of the area, and resize it to `size`, bilinear with aligned corners.

    Source: tf.image.crop_and_resize and convert_image_dtype, as used in the LIBERO evaluation.
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
