"""Encodings of `sensor_msgs/Image`: how each becomes RGB, or what it is if it is no picture.

Source of the names: sensor_msgs/image_encodings.hpp; `nv12` is that of hardware decoders.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]
Convert = Callable[[U8, int], U8]
"""Rows of bytes and the image's height -> RGB (H, W, 3); without padding of the rows."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PixelLayout:
    """Layout of an encoding.

    Attributes:
        pixel_bytes: bytes of a pixel in a row.
        convert: gives RGB; None if it is RGB already.
        rows: rows of bytes for `of` rows of the image.
        of: see `rows`; also what the height must be a multiple of.
        columns: what the width must be a multiple of.
        sample_bytes: bytes of a number; 2 if the byte order counts.
    """

    pixel_bytes: int
    convert: Convert | None = None
    rows: int = 1
    of: int = 1
    columns: int = 1
    sample_bytes: int = 1


def _channels(count: int, order: slice) -> Convert:
    """Choose the channels, of bytes."""
    return lambda rows, height: rows.reshape(height, -1, count)[:, :, order]


def _grey(rows: U8, height: int) -> U8:
    return np.repeat(rows.reshape(height, -1, 1), 3, axis=2)


def _wide(convert: Convert) -> Convert:
    """The same with little-endian numbers of 16 bits, of which the higher byte counts."""
    return lambda rows, height: convert(np.ascontiguousarray(rows[:, 1::2]), height)


def _packed(luma: int, u: int, v: int) -> Convert:
    """Four bytes for two pixels, with the places of the first luma, U and V."""

    def convert(rows: U8, height: int) -> U8:
        pairs = rows.reshape(height, -1, 4)
        return _yuv_to_rgb(rows[:, luma::2], pairs[:, :, u], pairs[:, :, v], (1, 2))

    return convert


def _planes(u: int, scale: int) -> Convert:
    """A plane of luma, then one of pairs of U and V; `scale` pixels share a pair per direction."""

    def convert(rows: U8, height: int) -> U8:
        pairs = rows[height:].reshape(height // scale, -1, 2)
        return _yuv_to_rgb(rows[:height], pairs[:, :, u], pairs[:, :, 1 - u], (scale, scale))

    return convert


_FRACTION_BITS = 5
"""Of the sums in 16 bits, whose largest value is 535 * 2**5."""


def _part(factor: float, black: int) -> NDArray[np.int16]:
    """Contribution of each value of a byte, in units of 2**-5."""
    parts: NDArray[np.int16] = np.rint(
        (np.arange(256) - black) * factor * 2**_FRACTION_BITS
    ).astype(np.int16)
    return parts


_Y, _CHROMA = 255 / 219, 255 / 224
_OF_Y = _part(_Y, 16) + np.int16(2 ** (_FRACTION_BITS - 1))  # rounds the sum
_RED_OF_V, _BLUE_OF_U = _part(1.402 * _CHROMA, 128), _part(1.772 * _CHROMA, 128)
_GREEN_OF_U, _GREEN_OF_V = _part(-0.344136 * _CHROMA, 128), _part(-0.714136 * _CHROMA, 128)


def _yuv_to_rgb(y: U8, u: U8, v: U8, scale: tuple[int, int]) -> U8:
    """Convert limited-range Y'CbCr (16..235, 16..240), as USB cameras send it; `scale` rows and
    columns share a value of U and V. Within 1 of the formula.

    Source: ITU-R BT.601-7, 2.5.1 and 2.5.3: R = 1.402 Cr, G = -0.344136 Cb - 0.714136 Cr,
    B = 1.772 Cb beside Y, scaled by 255/219 and 255/224.
    """
    luma = _OF_Y[y]
    rgb = np.empty((*y.shape, 3), np.uint8)
    for channel, part in enumerate((_RED_OF_V[v], _GREEN_OF_U[u] + _GREEN_OF_V[v], _BLUE_OF_U[u])):
        for axis, times in enumerate(scale):
            part = np.repeat(part, times, axis=axis) if times > 1 else part
        total = (luma + part) >> _FRACTION_BITS
        rgb[:, :, channel] = np.clip(total, 0, 255, out=total)
    return rgb


def _bayer(pattern: str) -> Convert:
    """Mosaic of single colours, such as `rggb`: bilinear interpolation, also at the borders."""

    def convert(rows: U8, height: int) -> U8:
        rgb = np.empty((*rows.shape, 3), np.uint8)
        for channel, colour in enumerate("rgb"):
            mask, weight = _sites(pattern, colour, *rows.shape)
            total = _blurred(np.where(mask, rows, 0).astype(np.uint16))
            rgb[:, :, channel] = (total + weight // 2) // weight
        return rgb

    return convert


@lru_cache(maxsize=12)
def _sites(
    pattern: str, colour: str, height: int, width: int
) -> tuple[NDArray[np.bool_], NDArray[np.uint16]]:
    """Pixels that measure a colour, and the sum of the weights of those near each pixel."""
    tile = np.array([one == colour for one in pattern]).reshape(2, 2)
    mask = np.tile(tile, (height // 2, width // 2))
    return mask, _blurred(mask.astype(np.uint16))


def _blurred(values: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Sum of each pixel and its neighbours, with the weights 1 2 1 in both directions."""
    padded = np.pad(values, 1)
    rows = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    found: NDArray[np.uint16] = rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]
    return found


_RGB, _BGR = slice(0, 3), slice(2, None, -1)
_8_BIT = {
    "bgr8": PixelLayout(pixel_bytes=3, convert=_channels(3, _BGR)),
    "rgba8": PixelLayout(pixel_bytes=4, convert=_channels(4, _RGB)),
    "bgra8": PixelLayout(pixel_bytes=4, convert=_channels(4, _BGR)),
    "mono8": PixelLayout(pixel_bytes=1, convert=_grey),
    **{
        f"bayer_{pattern}8": PixelLayout(
            pixel_bytes=1, convert=_bayer(pattern), of=2, rows=2, columns=2
        )
        for pattern in ("rggb", "bggr", "gbrg", "grbg")
    },
}
_UYVY = PixelLayout(pixel_bytes=2, convert=_packed(1, 0, 2), columns=2)
_YUYV = PixelLayout(pixel_bytes=2, convert=_packed(0, 1, 3), columns=2)
PICTURE_ENCODINGS = {
    "rgb8": PixelLayout(pixel_bytes=3),
    **_8_BIT,
    "8UC1": _8_BIT["mono8"],
    "8UC3": _8_BIT["bgr8"],  # without an order in its name; that of OpenCV, as cv_bridge has it
    "8UC4": _8_BIT["bgra8"],
    "yuv422": _UYVY,
    "uyvy": _UYVY,
    "yuv422_yuy2": _YUYV,
    "yuyv": _YUYV,
    "nv12": PixelLayout(pixel_bytes=1, convert=_planes(0, 2), rows=3, of=2, columns=2),
    "nv21": PixelLayout(pixel_bytes=1, convert=_planes(1, 2), rows=3, of=2, columns=2),
    "nv24": PixelLayout(pixel_bytes=1, convert=_planes(0, 1), rows=3),
    "rgb16": PixelLayout(pixel_bytes=6, convert=_wide(_channels(3, _RGB)), sample_bytes=2),
    **{
        f"{name.removesuffix('8')}16": PixelLayout(
            pixel_bytes=2 * one.pixel_bytes,
            convert=_wide(one.convert),
            of=one.of,
            rows=one.rows,
            columns=one.columns,
            sample_bytes=2,
        )
        for name, one in _8_BIT.items()
        if one.convert is not None
    },
}
"""Encodings of pictures."""
MEASURE_ENCODINGS = {
    "16UC1": "u2",
    "16SC1": "i2",
    "32SC1": "i4",
    "32FC1": "f4",
    "64FC1": "f8",
}
"""Encodings of depth and other measures, with one number a pixel, by numpy's code of its type."""
