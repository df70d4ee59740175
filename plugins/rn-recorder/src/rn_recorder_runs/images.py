"""Conversion of raw `sensor_msgs/Image` messages to `sensor_msgs/CompressedImage`, both as CDR,
without ROS, and to pixels.

Source: OMG CDR (little endian, members aligned to their size from the end of the 4-byte
encapsulation header) and the definitions of the two types; the field `format` is written as by
ROS's compressed_image_transport.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron import InvalidInputError, frame_from_compressed, image_from_message

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
_HEADER = b"\x00\x01\x00\x00"
_COLOURS = {"rgb8": ("RGB", 3), "bgr8": ("BGR", 3), "mono8": ("GRAY", 1)}


class MessageError(ValueError):
    """A serialized message is damaged."""


@dataclass(frozen=True, slots=True)
class RawImage:
    """A parsed image message; `data` shares the message's memory.

    Attributes:
        sec, nanosec: stamp.
        step: bytes per row.
    """

    sec: int
    nanosec: int
    frame_id: bytes
    height: int
    width: int
    encoding: str
    step: int
    data: memoryview

    @property
    def stamp_ns(self) -> int:
        """Capture time [ns]."""
        return self.sec * 1_000_000_000 + self.nanosec


class _Reader:
    def __init__(self, message: bytes) -> None:
        self._body = memoryview(message)[4:]
        self._at = 0

    def uint32(self) -> int:
        self._at = (self._at + 3) & ~3
        self._at += 4
        return int(struct.unpack_from("<I", self._body, self._at - 4)[0])

    def bytes_(self, length: int) -> memoryview:
        self._at += length
        if self._at > len(self._body):
            raise MessageError("an image message is cut short")
        return self._body[self._at - length : self._at]


def parse_image(message: bytes) -> RawImage:
    """Parse a little-endian CDR `sensor_msgs/Image`.

    Raises:
        MessageError: it is damaged or big endian.
    """
    if message[:2] != _HEADER[:2]:
        raise MessageError("the image is not little-endian CDR")
    try:
        reader = _Reader(message)
        sec, nanosec = reader.uint32(), reader.uint32()
        frame_id = bytes(reader.bytes_(reader.uint32()))[:-1]
        height, width = reader.uint32(), reader.uint32()
        encoding = bytes(reader.bytes_(reader.uint32()))[:-1].decode("ascii")
        reader.bytes_(1)
        step = reader.uint32()
        data = reader.bytes_(reader.uint32())
    except struct.error as error:
        raise MessageError("an image message is cut short") from error
    return RawImage(sec, nanosec, frame_id, height, width, encoding, step, data)


def to_jpeg(message: bytes, quality: int) -> bytes | None:
    """A CDR `Image` as a CDR `CompressedImage`; None if its encoding (depth, float) has no JPEG.

    Raises:
        MessageError: it is damaged.
    """
    import simplejpeg  # heavy

    raw = parse_image(message)
    if raw.encoding not in _COLOURS:
        return None
    colours, channels = _COLOURS[raw.encoding]
    rows = np.frombuffer(raw.data, np.uint8).reshape(raw.height, raw.step)
    pixels = rows[:, : raw.width * channels].reshape(raw.height, raw.width, channels)
    encoded: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(pixels), quality, colours, "420")
    kind = (
        f"{raw.encoding}; jpeg compressed {'mono8' if channels == 1 else 'bgr8'}".encode() + b"\0"
    )
    frame_id = raw.frame_id + b"\0"
    body = struct.pack("<II", raw.sec, raw.nanosec)
    for text in (frame_id, kind):
        body += b"\0" * (-len(body) % 4) + struct.pack("<I", len(text)) + text
    body += b"\0" * (-len(body) % 4) + struct.pack("<I", len(encoded))
    return _HEADER + body + encoded


def to_string(text: str) -> bytes:
    """A CDR `std_msgs/String`."""
    data = text.encode() + b"\0"
    return _HEADER + struct.pack("<I", len(data)) + data


def pixels_of(message: object, type_name: str) -> NDArray[np.uint8]:
    """A decoded `Image` or `CompressedImage` -> uint8 (H, W, 3), RGB.

    Raises:
        InvalidInputError: of another type, no picture, or damaged.
    """
    image: Any = message
    if type_name == COMPRESSED:
        return frame_from_compressed(image.data, image.format)
    if type_name != IMAGE:
        raise InvalidInputError(f"{type_name} is no image.")
    return image_from_message(image)
