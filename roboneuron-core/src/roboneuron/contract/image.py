"""Images of the contract: uint8 (H, W, 3), RGB; conversions from raw buffers, without ROS."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract.encodings import MEASURE_ENCODINGS, PICTURE_ENCODINGS
from roboneuron.errors import InvalidInputError

U8 = NDArray[np.uint8]

_ONE_CHANNEL = {**MEASURE_ENCODINGS, "mono16": "u2"}
_METRES = {"16UC1": 1e-3, "32FC1": 1.0}
"""Encodings of depth, and what one of their units is [m]."""
MAX_SIDE_PX = 8192
"""Largest accepted width or height; larger values count as corrupt."""


def check_rgb8(image: NDArray[Any]) -> U8:
    """Return `image` unchanged when it is uint8 (H, W, 3) with H, W >= 1.

    Raises:
        InvalidInputError: any other dtype or shape.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise InvalidInputError(
            f"An image is {image.dtype} {image.shape}, expected uint8 (H, W, 3) in RGB order."
        )
    return image


def frame_from_buffer(
    data: Any, *, width: int, height: int, step: int, encoding: str, is_bigendian: bool = False
) -> U8:
    """Return the RGB image (H, W, 3) held in an image message's buffer.

    `rgb8` without row padding is returned as a view on `data` (about 1 us); everything else costs
    a copy, and YUV and Bayer a conversion.

    Args:
        data: any buffer of bytes (array.array('B') as rclpy delivers it, bytes, ndarray).
        width, height: size in pixels.
        step: bytes per row, at least those of the pixels; the last row may lack its padding.
        encoding: a ROS image encoding, see `roboneuron.contract.encodings`.
        is_bigendian: byte order of numbers of 16 bits, of which the higher 8 are taken.

    Raises:
        InvalidInputError: an encoding that is unknown or no picture, a size that the encoding
            cannot have, or a buffer that does not hold the rows of `step` bytes.
    """
    layout = PICTURE_ENCODINGS.get(encoding)
    if layout is None:
        raise _unreadable(encoding)
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
        raise InvalidInputError(f"Image size {width}x{height} is outside 1..{MAX_SIDE_PX} pixels.")
    if layout.convert is not None and (width % layout.columns or height % layout.of):
        raise InvalidInputError(
            f"An image of {width}x{height} cannot be {encoding}, whose width is a multiple of "
            f"{layout.columns} and height of {layout.of}."
        )
    buffer = np.frombuffer(data, dtype=np.uint8)
    row_bytes, rows = width * layout.pixel_bytes, height * layout.rows // layout.of
    if step < row_bytes or buffer.size != step * rows:
        if step < row_bytes or not step * (rows - 1) + row_bytes <= buffer.size < step * rows:
            raise InvalidInputError(
                f"Image buffer holds {buffer.size} bytes with step {step}, expected {rows} rows of "
                f"at least {row_bytes} bytes for {width}x{height} {encoding}."
            )
        buffer = np.pad(buffer, (0, step * rows - buffer.size))
    pixels = buffer.reshape(rows, step)[:, :row_bytes]
    if layout.convert is None:
        return pixels.reshape(height, width, 3)
    if layout.sample_bytes > 1 and is_bigendian:
        pixels = pixels.reshape(rows, -1, layout.sample_bytes)[:, :, ::-1].reshape(rows, -1)
    return np.ascontiguousarray(layout.convert(pixels, height))


def image_from_message(message: Any) -> U8:
    """Return the RGB image (H, W, 3) of a `sensor_msgs/Image`, in the byte order that it names.

    Raises:
        InvalidInputError: as `frame_from_buffer`.
    """
    return frame_from_buffer(
        message.data,
        width=message.width,
        height=message.height,
        step=message.step,
        encoding=message.encoding,
        is_bigendian=bool(message.is_bigendian),
    )


def measure_from_message(message: Any) -> NDArray[Any]:
    """Return the numbers (H, W) of a `sensor_msgs/Image` of one channel; a view on its buffer
    without row padding.

    Raises:
        InvalidInputError: its encoding is neither a key of `MEASURE_ENCODINGS` nor `mono16`, or its
            buffer does not hold the rows.
    """
    code = _ONE_CHANNEL.get(message.encoding)
    if code is None:
        raise InvalidInputError(
            f"Image encoding {message.encoding[:60]!r} is no measure, expected one of "
            f"{', '.join(_ONE_CHANNEL)}."
        )
    dtype = np.dtype((">" if message.is_bigendian else "<") + code)
    raw = np.frombuffer(message.data, dtype=np.uint8)
    width, height, step = int(message.width), int(message.height), int(message.step)
    row_bytes = width * dtype.itemsize
    if not (height and width) or step < row_bytes or raw.size != step * height:
        raise InvalidInputError(
            f"Image buffer holds {raw.size} bytes with step {step}, expected {height} rows of at "
            f"least {row_bytes} bytes for {width}x{height} {message.encoding}."
        )
    return np.ascontiguousarray(raw.reshape(height, step)[:, :row_bytes]).view(dtype)


def depth_from_message(message: Any) -> NDArray[np.float32]:
    """Return the depth (H, W) [m] of a `sensor_msgs/Image`, NaN where it has a hole.

    Its encoding is `16UC1` [mm] or `32FC1` [m]; 0, infinite and negative values are holes. Source:
    REP 118, Depth Images.

    Raises:
        InvalidInputError: another encoding, or a buffer that does not hold the rows.
    """
    scale = _METRES.get(message.encoding)
    if scale is None:
        raise InvalidInputError(
            f"Image encoding {message.encoding[:60]!r} is no depth, expected one of "
            f"{', '.join(_METRES)}."
        )
    depth_m = measure_from_message(message).astype(np.float32) * np.float32(scale)
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = np.nan
    return depth_m


def _unreadable(encoding: str) -> InvalidInputError:
    if encoding in MEASURE_ENCODINGS:
        return InvalidInputError(
            f"Image encoding {encoding!r} is depth or another measure and no picture.",
            hint="Use the camera's topic of colour or grey images.",
        )
    small, known = encoding.lower(), ", ".join(PICTURE_ENCODINGS)
    return InvalidInputError(
        f"Image encoding {encoding[:60]!r} cannot be read, expected one of {known}.",
        hint=f"Let the driver write {small!r}." if small in PICTURE_ENCODINGS else "",
    )
