"""Images of the contract: uint8 (H, W, 3), RGB; conversions from raw buffers, without ROS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron.errors import InvalidInputError

U8 = NDArray[np.uint8]

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


_ENCODINGS: dict[str, tuple[int, Callable[[U8], U8] | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, lambda pixels: pixels[:, :, ::-1]),
    "rgba8": (4, lambda pixels: pixels[:, :, :3]),
    "bgra8": (4, lambda pixels: pixels[:, :, 2::-1]),
    "mono8": (1, lambda pixels: np.repeat(pixels, 3, axis=2)),
}
"""Number of channels, and the conversion to RGB."""


def frame_from_buffer(data: Any, *, width: int, height: int, step: int, encoding: str) -> U8:
    """Return the RGB image (H, W, 3) held in an image message's buffer.

    `rgb8` without row padding is returned as a view on `data` (about 1 us); everything else costs
    one copy.

    Args:
        data: any buffer of bytes (array.array('B') as rclpy delivers it, bytes, ndarray).
        width, height: size in pixels.
        step: bytes per row, at least width * channels.
        encoding: a ROS image encoding (sensor_msgs/image_encodings).

    Raises:
        InvalidInputError: unknown encoding, or a buffer that does not hold `height` rows of `step`
            bytes.
    """
    if encoding not in _ENCODINGS:
        raise InvalidInputError(
            f"Image encoding {encoding!r} cannot be read, expected one of {', '.join(_ENCODINGS)}."
        )
    channels, convert = _ENCODINGS[encoding]
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
        raise InvalidInputError(f"Image size {width}x{height} is outside 1..{MAX_SIDE_PX} pixels.")
    buffer = np.frombuffer(data, dtype=np.uint8)
    if step < width * channels or buffer.size != step * height:
        raise InvalidInputError(
            f"Image buffer holds {buffer.size} bytes with step {step}, expected {height} rows of "
            "at least "
            f"{width * channels} bytes for {width}x{height} {encoding}."
        )
    pixels = buffer.reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    return pixels if convert is None else np.ascontiguousarray(convert(pixels))
