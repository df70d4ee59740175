"""Images on their way: cropped and shrunk to what the model takes, and coded."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_backend_shared.fields import array, field, integer
from rn_backend_shared.frames import Document, FrameError
from roboneuron import Frame, InvalidInputError

Coding = Literal["raw", "png", "jpeg"]
CODINGS: tuple[Coding, ...] = ("raw", "png", "jpeg")
"""From the one that needs most of the link to the one that needs least; the last one loses."""
Size = tuple[int, int]
"""Width and height [px]."""
Rectangle = tuple[int, int, int, int]
"""Left, top, width and height [px]."""
MOST_SIDE_PX = 8192
CROPPED = "cropped"
"""Entry of a frame that is sent: the robot has cropped it."""
_PNG_LEVEL = 1
"""Higher ones take several times as long for a few per cent."""


def crop(frame: Frame, rectangle: Rectangle) -> Frame:
    """What a rectangle shows of the frame, its calibration as well.

    Raises:
        InvalidInputError: the image does not hold it.
    """
    left, top, width, height = rectangle
    all_height, all_width = frame.image.shape[:2]
    if left + width > all_width or top + height > all_height:
        raise InvalidInputError(
            f"The image of camera {frame.camera!r} is {all_width} x {all_height}, `crop` takes "
            f"{width} x {height} at {left}, {top} of it."
        )
    known = frame.calibration
    if known is not None:
        moved = known.intrinsics.copy()
        moved[:2, 2] -= (left, top)
        known = replace(known, intrinsics=moved)
    image = np.ascontiguousarray(frame.image[top : top + height, left : left + width])
    return replace(frame, image=image, calibration=known)


def fit(frame: Frame, size: Size) -> Frame:
    """The frame shrunk to a size, its calibration as well; the frame itself where it is not larger.

    The filter is Pillow's bilinear one, which averages over the pixels that become one.
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
    """What is sent for an image.

    Args:
        image: uint8 (H, W, 3), RGB.
        coding: how; `raw` is the image itself.
        quality: of JPEG, 1 .. 100.
    """
    if coding == "raw":
        return image
    from PIL import Image  # heavy

    made = io.BytesIO()
    if coding == "png":
        Image.fromarray(image).save(made, "png", compress_level=_PNG_LEVEL)
    else:
        # colours in full resolution: cubes are told apart by them
        Image.fromarray(image).save(made, "jpeg", quality=quality, subsampling=0)
    height, width = image.shape[:2]
    data = np.frombuffer(made.getbuffer(), dtype=np.uint8)
    return {"coding": coding, "height": height, "width": width, "data": data}


def decode_image(value: object) -> NDArray[np.uint8]:
    """The image that was sent.

    Raises:
        FrameError: it is none, or not of the size that was announced.
    """
    if isinstance(value, np.ndarray):
        raw: NDArray[np.uint8] = array(value, "an image", "|u1", (None, None, 3))
        return raw
    from PIL import Image, UnidentifiedImageError  # heavy

    coding = field(value, "coding")
    height, width = (
        integer(field(value, name), name, 1, MOST_SIDE_PX) for name in ("height", "width")
    )
    data = array(field(value, "data"), "data of an image", "|u1", (None,))
    if coding not in ("png", "jpeg"):
        raise FrameError("the coding of an image is not known")
    try:
        with Image.open(io.BytesIO(data.tobytes()), formats=(coding,)) as opened:
            # before anything is unpacked: a small file can announce a large image
            if opened.size != (width, height) or opened.mode != "RGB":
                raise FrameError(f"an image of {opened.size} {opened.mode} was not announced")
            decoded: NDArray[np.uint8] = np.asarray(opened, dtype=np.uint8)
    except FrameError:
        raise
    except (OSError, ValueError, SyntaxError, EOFError, UnidentifiedImageError) as error:
        raise FrameError(f"an image cannot be decoded: {error}") from error
    except Image.DecompressionBombError as error:
        raise FrameError("an image is larger than allowed") from error
    return decoded


def image_bytes(document: Document) -> int:
    """Bytes of the images of an observation as it is sent."""
    total = 0
    for frame in document["frames"].values():
        image = frame["image"]
        total += (image if isinstance(image, np.ndarray) else image["data"]).nbytes
    return total
