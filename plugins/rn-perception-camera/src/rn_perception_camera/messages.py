"""Conversion of camera drivers' image messages to RGB pixels, with validation."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from roboneuron import MAX_SIDE_PX, InvalidInputError, frame_from_buffer

if TYPE_CHECKING:
    from sensor_msgs.msg import CompressedImage, Image

U8 = NDArray[np.uint8]

_MODES = ("L", "RGB", "RGBA")
"""Pillow's names of 8-bit grey and colour pixels."""


def to_rgb(message: Image) -> U8:
    """sensor_msgs/Image -> uint8 (H, W, 3) RGB; `rgb8` without row padding shares the message's
    memory.

    Raises:
        InvalidInputError: an encoding that is unknown or no picture, or a damaged size.
    """
    return frame_from_buffer(
        message.data,
        width=message.width,
        height=message.height,
        step=message.step,
        encoding=message.encoding,
        is_bigendian=bool(message.is_bigendian),
    )


def decompress(message: CompressedImage) -> U8:
    """sensor_msgs/CompressedImage (JPEG or PNG) -> uint8 (H, W, 3) RGB.

    Raises:
        InvalidInputError: another format, depth data, more than 8 bits, or a damaged or huge image.
    """
    if "compressedDepth" in message.format:
        raise InvalidInputError(
            f"Its format is {message.format!r}, which is depth and no picture.",
            hint="Use the topic of colour or grey images.",
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Pillow.DecompressionBombWarning)
            picture = Pillow.open(io.BytesIO(bytes(message.data)), formats=("JPEG", "PNG"))
        if max(picture.size) > MAX_SIDE_PX:
            raise InvalidInputError(
                f"Its size is {picture.width}x{picture.height}, at most {MAX_SIDE_PX} is taken."
            )
        if picture.mode not in _MODES:
            raise InvalidInputError(
                f"Its pixels are {picture.mode!r}, expected one of {', '.join(_MODES)}.",
                hint="Let the driver compress 8-bit grey or colour images.",
            )
        return np.asarray(picture.convert("RGB"))
    except (
        OSError,
        SyntaxError,
        ValueError,
        Pillow.DecompressionBombError,
        Pillow.DecompressionBombWarning,
    ) as error:
        raise InvalidInputError(
            f"{len(message.data)} bytes of format {message.format[:60]!r} are no whole JPEG or PNG "
            f"image ({type(error).__name__}).",
            hint='Let the driver compress as JPEG or PNG, or use the raw topic: transport = "raw".',
        ) from error
