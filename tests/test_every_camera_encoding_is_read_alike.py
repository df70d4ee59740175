"""Every encoding of images, read by the camera source of policies, the agent's read tool,
get_camera_image and the recorder's export: the same RGB everywhere, judged by conversions of this
file; and what is no picture is refused by its name. The same of compressed ones, which policy
servers and evaluations receive as well.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Pillow

pytest.importorskip("rn_perception_camera")
pytest.importorskip("rn_recorder_runs")
pytest.importorskip("rn_backend_openpi")
pytest.importorskip("rn_eval")

from sensor_msgs.msg import CompressedImage, Image

from rn_backend_openpi.messages import decode_image
from rn_eval.wire import unpack
from rn_recorder_runs.images import pixels_of
from roboneuron import CameraProfile, InvalidInputError, frame_from_compressed, image_from_message
from roboneuron.modules.inference.inputs import CalibratedCamera
from roboneuron.ros.messages import frame_from_message
from roboneuron.tools.inspect.camera import encode
from roboneuron.tools.ros.interfaces.picture import to_picture

U8 = NDArray[np.uint8]
WIDTH, HEIGHT = 8, 6
FRONT = CameraProfile(name="front", role="primary", frame_id="front", width=WIDTH, height=HEIGHT)
Pixel = Callable[[U8, int, int], tuple[float, float, float]]
"""RGB of the pixel at row and column, from the rows of bytes; the plain formula."""


def yuv(y: int, u: int, v: int) -> tuple[float, float, float]:
    """Source: ITU-R BT.601-7, limited range, with the matrix from Kr = 0.299 and Kb = 0.114."""
    luma, blue, red = (y - 16) / 219, (u - 128) / 224, (v - 128) / 224
    r = luma + 2 * (1 - 0.299) * red
    b = luma + 2 * (1 - 0.114) * blue
    g = (luma - 0.299 * r - 0.114 * b) / 0.587
    return 255 * r, 255 * g, 255 * b


def channels(count: int, order: tuple[int, int, int], size: int = 1) -> Pixel:
    def pixel(rows: U8, row: int, column: int) -> tuple[float, float, float]:
        values = rows[row, column * count * size :].tolist()
        return tuple(values[one * size + size - 1] for one in order)  # type: ignore[return-value]

    return pixel


def packed(y: int, u: int, v: int) -> Pixel:
    def pixel(rows: U8, row: int, column: int) -> tuple[float, float, float]:
        four = rows[row, column // 2 * 4 :].tolist()
        return yuv(four[y + 2 * (column % 2)], four[u], four[v])

    return pixel


def planes(u: int, scale: int) -> Pixel:
    def pixel(rows: U8, row: int, column: int) -> tuple[float, float, float]:
        chroma = rows[HEIGHT:].reshape(-1).tolist()
        at = (row // scale * (WIDTH // scale) + column // scale) * 2
        return yuv(int(rows[row, column]), chroma[at + u], chroma[at + 1 - u])

    return pixel


def bayer(pattern: str, size: int = 1) -> Pixel:
    """Mean of the neighbours that measure the colour, by bilinear weights."""

    def pixel(rows: U8, row: int, column: int) -> tuple[float, float, float]:
        found = []
        for colour in "rgb":
            total = weights = 0.0
            for y in range(max(0, row - 1), min(HEIGHT, row + 2)):
                for x in range(max(0, column - 1), min(WIDTH, column + 2)):
                    if pattern[y % 2 * 2 + x % 2] == colour:
                        weight = (2 - abs(y - row)) * (2 - abs(x - column))
                        total += weight * int(rows[y, x * size + size - 1])
                        weights += weight
            found.append(total / weights)
        return found[0], found[1], found[2]

    return pixel


RGB, BGR, GREY = (0, 1, 2), (2, 1, 0), (0, 0, 0)
# encoding -> bytes a pixel, rows of bytes, formula, largest difference
PICTURES: dict[str, tuple[int, int, Pixel, float]] = {
    "rgb8": (3, 6, channels(3, RGB), 0),
    "bgr8": (3, 6, channels(3, BGR), 0),
    "rgba8": (4, 6, channels(4, RGB), 0),
    "bgra8": (4, 6, channels(4, BGR), 0),
    "mono8": (1, 6, channels(1, GREY), 0),
    "8UC1": (1, 6, channels(1, GREY), 0),
    "8UC3": (3, 6, channels(3, BGR), 0),
    "8UC4": (4, 6, channels(4, BGR), 0),
    "rgb16": (6, 6, channels(3, RGB, 2), 0),
    "bgr16": (6, 6, channels(3, BGR, 2), 0),
    "rgba16": (8, 6, channels(4, RGB, 2), 0),
    "bgra16": (8, 6, channels(4, BGR, 2), 0),
    "mono16": (2, 6, channels(1, GREY, 2), 0),
    "yuv422": (2, 6, packed(1, 0, 2), 1),
    "uyvy": (2, 6, packed(1, 0, 2), 1),
    "yuv422_yuy2": (2, 6, packed(0, 1, 3), 1),
    "yuyv": (2, 6, packed(0, 1, 3), 1),
    "nv12": (1, 9, planes(0, 2), 1),
    "nv21": (1, 9, planes(1, 2), 1),
    "nv24": (1, 18, planes(0, 1), 1),
    **{f"bayer_{p}8": (1, 6, bayer(p), 1) for p in ("rggb", "bggr", "gbrg", "grbg")},
    **{f"bayer_{p}16": (2, 6, bayer(p, 2), 1) for p in ("rggb", "bggr", "gbrg", "grbg")},
}
MEASURES = ("16UC1", "16SC1", "32SC1", "32FC1", "64FC1")
UNKNOWN = ("", "RGB8", "theora", "32FC3", "8UC2", "bayer_rggb")
WIDE = [name for name in PICTURES if name.endswith("16")]


def stamped(message: Any) -> Any:
    message.header.stamp.sec = 1
    return message


def picture(name: str, padding: int = 0, big: bool = False, cut: int = 0) -> tuple[Image, U8]:
    """A message with random content, and its rows of little-endian bytes."""
    size, count, *_ = PICTURES[name]
    rng = np.random.default_rng(len(name) + size)
    rows = rng.integers(0, 256, (count, WIDTH * size), dtype=np.uint8)
    sent = rows.reshape(count, -1, 2)[:, :, ::-1].reshape(count, -1) if big else rows
    padded = np.pad(sent, ((0, 0), (0, padding)), constant_values=77)
    data = padded.tobytes()
    message = Image(width=WIDTH, height=HEIGHT, encoding=name, step=padded.shape[1])
    message.is_bigendian = int(big)
    message.data = data[: len(data) - cut]
    return stamped(message), rows


def expected(name: str, rows: U8) -> NDArray[np.float64]:
    pixel = PICTURES[name][2]
    found = [[pixel(rows, y, x) for x in range(WIDTH)] for y in range(HEIGHT)]
    return np.clip(np.array(found), 0, 255)


def opened(data: bytes) -> U8:
    return np.asarray(Pillow.open(io.BytesIO(data)).convert("RGB"))


def inferred(message: Image) -> U8:
    return CalibratedCamera(FRONT).to_frame(message).image


def shown(message: Image) -> U8:
    return opened(encode(frame_from_message(message, "front"), "png").data)


def exported(message: Image) -> U8:
    return pixels_of(message, "sensor_msgs/msg/Image")


EXACT: dict[str, Callable[[Image], U8]] = {
    "source": image_from_message,
    "inference": inferred,
    "get_camera_image": shown,
    "export": exported,
}


@pytest.mark.parametrize("reader", EXACT)
@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("padding", [0, 4])
def test_an_encoding_becomes_the_rgb_of_its_formula(name: str, reader: str, padding: int) -> None:
    message, rows = picture(name, padding)
    found = EXACT[reader](message).astype(float)
    assert found.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(found - expected(name, rows)).max() <= PICTURES[name][3]


@pytest.mark.parametrize("reader", EXACT)
@pytest.mark.parametrize("name", WIDE)
def test_the_byte_order_of_16_bits_is_respected(name: str, reader: str) -> None:
    message, rows = picture(name, big=True)
    found = EXACT[reader](message).astype(float)
    assert np.abs(found - expected(name, rows)).max() <= PICTURES[name][3]


@pytest.mark.parametrize("name", PICTURES)
def test_the_read_tool_shows_every_picture(name: str) -> None:
    message, rows = picture(name)
    found = to_picture(message, longest_side_px=640)
    assert (found.width, found.height) == (WIDTH, HEIGHT)
    if name in ("mono8", "8UC1"):  # the others are JPEG, or stretched
        assert np.array_equal(opened(found.data), expected(name, rows))


READERS: dict[str, Callable[[Image], object]] = {
    **EXACT,
    "read tool": lambda message: to_picture(message, longest_side_px=640),
}


@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_picture_is_refused_by_its_name(reader: str) -> None:
    for name in (*MEASURES, *UNKNOWN):
        message = stamped(Image(width=WIDTH, height=HEIGHT, encoding=name, step=64))
        message.data = bytes(64 * HEIGHT)
        if reader == "read tool" and name in MEASURES:
            assert name in to_picture(message, longest_side_px=640).note
            continue
        with pytest.raises(
            InvalidInputError, match="no picture" if name in MEASURES else "expected one"
        ) as e:
            READERS[reader](message)
        assert repr(name) in str(e.value)
    assert "'rgb8'" in str(_error(Image(width=8, height=6, encoding="RGB8", step=24)))


def _error(message: Image) -> InvalidInputError:
    with pytest.raises(InvalidInputError) as caught:
        image_from_message(message)
    return caught.value


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("name", PICTURES)
def test_sizes_that_do_not_fit_are_refused(name: str, reader: str) -> None:
    whole, _ = picture(name)
    short, _ = picture(name, cut=1)
    narrow, _ = picture(name)
    narrow.step -= 1
    none, _ = picture(name)
    none.width = none.height = none.step = 0
    for message in (short, narrow, none):
        with pytest.raises(InvalidInputError):
            READERS[reader](message)
    if name.startswith(("yu", "uyvy", "bayer", "nv12", "nv21")):  # two columns share values
        whole.width -= 1
        with pytest.raises(InvalidInputError):
            READERS[reader](whole)


@pytest.mark.parametrize("name", PICTURES)
def test_the_last_row_may_lack_its_padding(name: str) -> None:
    message, rows = picture(name, padding=4, cut=4)
    found = image_from_message(message).astype(float)
    assert np.abs(found - expected(name, rows)).max() <= PICTURES[name][3]


def sharp() -> U8:
    """Grey and colours that JPEG keeps nearly: ramps in each channel."""
    ramp = np.linspace(40, 200, 16).astype(np.uint8)
    return np.stack(
        [np.tile(ramp, (8, 1)), np.full((8, 16), 90, np.uint8), np.tile(ramp[::-1], (8, 1))], 2
    )


def file_of(kind: str, form: str, **saved: Any) -> bytes:
    buffer = io.BytesIO()
    picture = Pillow.fromarray(sharp())
    if kind == "I;16":
        picture = Pillow.fromarray(np.full((8, 16), 40_000, np.uint16))
    else:
        picture = picture.convert(kind)
    picture.save(buffer, form, **saved)
    return buffer.getvalue()


def compressed(data: bytes, form: str) -> CompressedImage:
    message = stamped(CompressedImage(format=form))
    message.data = data
    return message


def coded(message: CompressedImage) -> U8:
    """As a policy server receives it."""
    sent = {"coding": "png", "height": 8, "width": 16, "data": np.frombuffer(message.data, "|u1")}
    return decode_image(sent)


def evaluated(message: CompressedImage) -> U8:
    """As an evaluation of a policy receives it."""
    image = {"__image__": True, "format": "png", "data": bytes(message.data)}
    sent = {"type": "observation", "payload": {"image": image}, "seq": 1, "timestamp": 1.0}
    return unpack(msgpack.packb(sent)).payload["image"]


FILES: dict[str, Callable[[CompressedImage], U8]] = {
    "policy": lambda message: frame_from_compressed(message.data, message.format),
    "read tool": lambda message: opened(to_picture(message, longest_side_px=640).data),
    "export": lambda message: pixels_of(message, "sensor_msgs/msg/CompressedImage"),
    "policy server": coded,
    "evaluation": evaluated,
}
NAMED = ("policy", "read tool", "export")
"""Readers of `CompressedImage`, whose format word is known to them."""
JPEG, PNG = file_of("RGB", "JPEG", quality=95, subsampling=0), file_of("RGB", "PNG")
COMPRESSED: dict[str, tuple[bytes, str, str]] = {
    "jpeg": (JPEG, "jpeg", "RGB"),
    "grey jpeg": (file_of("L", "JPEG", quality=95), "yuv422_yuy2; jpeg compressed mono8", "L"),
    "progressive": (file_of("RGB", "JPEG", quality=95, progressive=True), "jpeg", "RGB"),
    "png": (PNG, "rgb8; png compressed bgr8", "RGB"),
    "grey png": (file_of("L", "PNG"), "png", "L"),
    "png with alpha": (file_of("RGBA", "PNG"), "png", "RGB"),
    "jpeg called png": (JPEG, "png", "RGB"),
    "png without a word": (PNG, "", "RGB"),
    "png called h264": (PNG, "h264", "RGB"),
    "bytes after the end": (JPEG + b"abc", "jpeg", "RGB"),
}


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def bomb(width: int, height: int) -> bytes:
    """A PNG of that size in its header, with the rows of another one."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    rows = chunk(b"IDAT", zlib.compress(bytes(1000)))
    return b"\x89PNG\r\n\x1a\n" + head + rows + chunk(b"IEND", b"")


SIZE_AT = JPEG.index(b"\xff\xc0") + 5
DAMAGED: dict[str, tuple[bytes, str]] = {
    "nothing": (b"", "jpeg"),
    "text": (b"<svg/>", "jpeg"),
    "half a jpeg": (JPEG[: len(JPEG) // 2], "jpeg"),
    "half a png": (PNG[: len(PNG) // 2], "png"),
    "a header": (JPEG[:20], "jpeg"),
    "no size": (JPEG[:SIZE_AT] + bytes(4) + JPEG[SIZE_AT + 4 :], "jpeg"),
    "a huge jpeg": (JPEG[:SIZE_AT] + b"\xff\xff\xff\xff" + JPEG[SIZE_AT + 4 :], "jpeg"),
    "a broad png": (bomb(8193, 1), "png"),
    "a huge png": (bomb(12_000, 12_000), "png"),
    "a bomb": (bomb(65_000, 65_000), "png"),
    "text that unpacks to much": (
        PNG[:33] + chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(80 << 20))) + PNG[33:],
        "png",
    ),
    "a changed checksum": (PNG[:29] + b"abcd" + PNG[33:], "png"),
    "16 bits": (file_of("I;16", "PNG"), "16UC1; png compressed"),
    "ink": (file_of("CMYK", "JPEG"), "jpeg"),
    "a stream": (b"\0\0\0\1gabc", "h264"),
    "webp": (b"RIFF\x1a\0\0\0WEBPVP8L", "webp"),
}


@pytest.mark.parametrize("reader", FILES)
@pytest.mark.parametrize("name", COMPRESSED)
def test_compressed_pictures_are_read_by_their_content(name: str, reader: str) -> None:
    data, form, kind = COMPRESSED[name]
    found = FILES[reader](compressed(data, form)).astype(float)
    expected_rgb = np.asarray(Pillow.fromarray(sharp()).convert(kind).convert("RGB"))
    assert found.shape == (8, 16, 3)
    # JPEG loses a little, twice where a tool encodes anew
    assert np.abs(found - expected_rgb).mean() < 4


@pytest.mark.parametrize("reader", FILES)
@pytest.mark.parametrize("name", DAMAGED)
def test_compressed_data_that_are_no_picture_are_refused(name: str, reader: str) -> None:
    data, form = DAMAGED[name]
    with pytest.raises(InvalidInputError) as caught:
        FILES[reader](compressed(data, form))
    assert "0x" not in str(caught.value)


@pytest.mark.parametrize("reader", NAMED)
def test_compressed_depth_is_refused_whatever_it_contains(reader: str) -> None:
    with pytest.raises(InvalidInputError, match="compressedDepth"):
        FILES[reader](compressed(PNG, "16UC1; compressedDepth png"))


@pytest.mark.parametrize("file", [JPEG, PNG], ids=["jpeg", "png"])
def test_changed_bytes_give_a_picture_or_one_error(file: bytes) -> None:
    drawn = np.random.default_rng(7)
    for _ in range(1_000):
        data = bytearray(file)
        for _ in range(int(drawn.integers(1, 6))):
            data[int(drawn.integers(len(data)))] = int(drawn.integers(256))
        if drawn.random() < 0.2:
            del data[int(drawn.integers(len(data))) :]
        try:
            read = frame_from_compressed(bytes(data), "jpeg")
        except InvalidInputError:
            continue
        assert read.dtype == np.uint8
        assert read.shape[2] == 3
