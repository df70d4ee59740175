"""Camera messages as PNG or JPEG bytes that an MCP client can show.

Depth and 16 bit images are scaled to grey between their smallest and largest finite value, which
the note states.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from roboneuron.compressed_image import frame_from_compressed
from roboneuron.contract import image_from_message
from roboneuron.contract.encodings import MEASURE_ENCODINGS
from roboneuron.contract.image import measure_from_message

if TYPE_CHECKING:
    import PIL.Image
    from sensor_msgs.msg import CompressedImage, Image

_STRETCHED = (*MEASURE_ENCODINGS, "mono16")
"""Encodings that are stretched to grey; of `mono16`, most cameras use 10 or 12 bits."""
_GREY = ("mono8", "8UC1")
_JPEG_QUALITY = 85
PICTURE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""Message types that can be shown as a picture."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MessagePicture:
    """An image for an agent.

    Attributes:
        path: field path inside the message, empty when the message itself is the image.
        data: the encoded file.
        mime_type: "image/jpeg" (colour) or "image/png" (grey, depth).
        width, height: size as encoded [px].
        note: changes: scaled down, stretched to grey.
    """

    path: str
    data: bytes
    mime_type: str
    width: int
    height: int
    note: str = ""


def to_picture(
    message: Image | CompressedImage, *, longest_side_px: int, path: str = ""
) -> MessagePicture:
    """Return an Image or CompressedImage message as a picture of at most `longest_side_px`.

    Raises:
        InvalidInputError: the encoding is unknown or the buffer is incomplete.
    """
    from PIL import Image  # heavy: only where pictures are made

    note = ""
    if hasattr(message, "format"):
        image = Image.fromarray(frame_from_compressed(message.data, message.format))
    else:
        if message.encoding in _STRETCHED:
            grey, note = _to_grey(message, message.encoding)
            image = Image.fromarray(grey)
        else:
            image = _to_colour(message)
    if max(image.size) > longest_side_px:
        note = f"{note + '; ' if note else ''}scaled down from {image.width}x{image.height}"
        image.thumbnail((longest_side_px, longest_side_px))
    buffer = io.BytesIO()
    grey_mode = image.mode == "L"
    if grey_mode:
        image.save(buffer, "PNG")
    else:
        image.convert("RGB").save(buffer, "JPEG", quality=_JPEG_QUALITY)
    return MessagePicture(
        path=path,
        data=buffer.getvalue(),
        mime_type="image/png" if grey_mode else "image/jpeg",
        width=image.width,
        height=image.height,
        note=note,
    )


def _to_colour(message: Image) -> PIL.Image.Image:
    """Convert the other encodings. Raises as `image_from_message`."""
    from PIL import Image as Picture  # heavy: only where pictures are made

    pixels = image_from_message(message)
    is_grey = message.encoding in _GREY
    return Picture.fromarray(np.ascontiguousarray(pixels[:, :, 0]) if is_grey else pixels)


def _to_grey(message: Image, encoding: str) -> tuple[NDArray[np.uint8], str]:
    values = measure_from_message(message).astype(np.float64)
    finite = np.isfinite(values)
    if not finite.any():
        return np.zeros(values.shape, dtype=np.uint8), f"{encoding} without a finite value"
    low, high = float(values[finite].min()), float(values[finite].max())
    scaled = (np.where(finite, values, low) - low) * (255.0 / (high - low) if high > low else 0.0)
    return scaled.astype(np.uint8), f"{encoding} shown as grey, black {low:g} to white {high:g}"
