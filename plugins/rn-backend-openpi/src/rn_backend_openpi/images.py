"""Images for transmission: shrunk to the model's input, and coded."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_backend_openpi.wire import array
from roboneuron import (
    MAX_SIDE_PX,
    ForeignDataError,
    Frame,
    InvalidInputError,
    foreign,
    frame_from_compressed,
)

Coding = Literal["raw", "png", "jpeg"]
CODINGS: tuple[Coding, ...] = ("raw", "png", "jpeg")
"""Codings, from the largest data to the smallest; the last one is lossy."""
Size = tuple[int, int]
"""Width and height [px]."""
_PNG_LEVEL = 1
"""Higher levels take several times as long to save a few per cent."""


def fit(frame: Frame, size: Size) -> Frame:
    """Shrink the frame to a size, and adapt its calibration; a frame that is not larger is returned
    unchanged.

    The filter is Pillow's bilinear one, which averages over the merged pixels.
    """
    from PIL import Image  # heavy

    height, width = frame.image.shape[:2]
    if (width, height) == size or width < size[0] or height < size[1]:
        return frame
    image = Image.fromarray(frame.image).resize(size, Image.Resampling.BILINEAR)
    known = frame.calibration
    if known is not None:
        scale = np.diag([size[0] / width, size[1] / height, 1.0])
        known = replace(known, intrinsics=scale @ known.intrinsics)
    return replace(frame, image=np.asarray(image, dtype=np.uint8), calibration=known)


def encode_image(image: NDArray[np.uint8], coding: Coding, quality: int) -> object:
    """Encode an image for sending.

    Args:
        image: uint8 (H, W, 3), RGB.
        coding: `raw` keeps the image itself.
        quality: quality of JPEG, 1 .. 100.
    """
    if coding == "raw":
        return image
    from PIL import Image  # heavy

    made = io.BytesIO()
    if coding == "png":
        Image.fromarray(image).save(made, "png", compress_level=_PNG_LEVEL)
    else:
        # full colour resolution, because cubes are distinguished by colour
        Image.fromarray(image).save(made, "jpeg", quality=quality, subsampling=0)
    height, width = image.shape[:2]
    data = np.frombuffer(made.getbuffer(), dtype=np.uint8)
    return {"coding": coding, "height": height, "width": width, "data": data}


def decode_image(value: object) -> NDArray[np.uint8]:
    """Decode a received image.

    Raises:
        ForeignDataError: it is invalid, or its size differs from the announced one.
    """
    if isinstance(value, np.ndarray):
        raw: NDArray[np.uint8] = array(value, "an image", "|u1", (None, None, 3))
        return raw
    coding = foreign.field(value, "coding")
    height, width = (
        foreign.integer(foreign.field(value, name), name, 1, MAX_SIDE_PX)
        for name in ("height", "width")
    )
    data = array(foreign.field(value, "data"), "data of an image", "|u1", (None,))
    if coding not in ("png", "jpeg"):
        raise ForeignDataError("the coding of an image is unknown")
    try:
        decoded: NDArray[np.uint8] = frame_from_compressed(data, coding)
    except InvalidInputError as error:
        raise ForeignDataError(error.message.rstrip(".")) from error
    if decoded.shape != (height, width, 3):
        raise ForeignDataError(f"an image of {decoded.shape} was not announced")
    return decoded


def image_bytes(image: object) -> int:
    """Size of a coded image in bytes."""
    data = image["data"] if isinstance(image, dict) else image
    return int(np.asarray(data).nbytes)
