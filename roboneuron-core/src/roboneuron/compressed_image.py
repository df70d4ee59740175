"""Compressed images of cameras, recordings and policy servers, decoded in one place.

Not part of the contract, which needs numpy alone.
"""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract.image import MAX_SIDE_PX
from roboneuron.errors import InvalidInputError

_MODES = ("L", "RGB", "RGBA")
"""Pillow's names of 8-bit grey and colour pixels."""


def frame_from_compressed(data: Any, format: str) -> NDArray[np.uint8]:
    """Return the RGB image (H, W, 3) of a JPEG or PNG file in memory.

    The content decides, not the format's words, which many drivers do not set.

    Args:
        data: any buffer of bytes.
        format: that of a `sensor_msgs/CompressedImage`, for messages; "compressedDepth" in it
            means that the data are no picture.

    Raises:
        InvalidInputError: neither a JPEG nor a PNG file, one that is damaged or cut short, more
            than 8 bits, or a size beyond `MAX_SIDE_PX`, which is checked before decompression.
    """
    from PIL import Image  # heavy

    if "compressedDepth" in format:
        raise InvalidInputError(
            f"An image of the format {format[:60]!r} is depth and no picture.",
            hint="Use the topic of colour or grey images; that of raw depth can be read as well.",
        )
    try:
        image = Image.open(io.BytesIO(data), formats=("JPEG", "PNG"))
        if max(image.size) > MAX_SIDE_PX:
            raise InvalidInputError(
                f"A compressed image has {image.width}x{image.height} pixels, at most "
                f"{MAX_SIDE_PX} in each direction are read."
            )
        if image.mode not in _MODES:
            raise InvalidInputError(
                f"The pixels of a compressed image are {image.mode!r}, expected one of "
                f"{', '.join(_MODES)}.",
                hint="Let the driver compress 8-bit grey or colour images.",
            )
        return np.asarray(image.convert("RGB"))
    # what Pillow raises for files that are damaged; a warning where warnings are errors
    except (
        *(OSError, SyntaxError, ValueError, EOFError, LookupError, struct.error, Warning),
        Image.DecompressionBombError,
    ) as error:
        raise InvalidInputError(
            f"{len(data)} bytes of the format {format[:60]!r} are no whole JPEG or PNG image "
            f"({type(error).__name__}).",
            hint="Let the driver compress as JPEG or PNG.",
        ) from error
