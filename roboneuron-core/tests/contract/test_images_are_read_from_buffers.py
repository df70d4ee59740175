"""Images: buffers of any readable encoding become uint8 RGB; damaged ones are refused."""

from __future__ import annotations

import array
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roboneuron.contract import Frame, check_rgb8, depth_from_message, frame_from_buffer
from roboneuron.errors import InvalidInputError

CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}


def _message(rgb, encoding, padding):
    """Bytes and step of an image message with the content `rgb`."""
    height, width, _ = rgb.shape
    alpha = np.full((height, width, 1), 9, np.uint8)
    pixels = {
        "rgb8": rgb,
        "bgr8": rgb[:, :, ::-1],
        "rgba8": np.concatenate([rgb, alpha], axis=2),
        "bgra8": np.concatenate([rgb[:, :, ::-1], alpha], axis=2),
        "mono8": rgb[:, :, :1],
    }[encoding]
    rows = pixels.reshape(height, -1)
    rows = np.concatenate([rows, np.zeros((height, padding), np.uint8)], axis=1)
    return rows.tobytes(), rows.shape[1]


@given(
    st.sampled_from(sorted(CHANNELS)),
    st.integers(1, 9),
    st.integers(1, 9),
    st.integers(0, 5),
    st.integers(0, 2**32 - 1),
)
def test_every_readable_encoding_becomes_the_same_rgb(encoding, width, height, padding, seed):
    rgb = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    if encoding == "mono8":
        rgb = np.repeat(rgb[:, :, :1], 3, axis=2)
    data, step = _message(rgb, encoding, padding)
    image = frame_from_buffer(data, width=width, height=height, step=step, encoding=encoding)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, rgb)


def test_rgb8_without_padding_is_a_view():
    data = array.array("B", bytes(range(24)))
    image = frame_from_buffer(data, width=4, height=2, step=12, encoding="rgb8")
    assert np.shares_memory(image, np.frombuffer(data, np.uint8))


@pytest.mark.parametrize("encoding", ["theora", "", "RGB8"])
def test_another_encoding_is_refused_and_named(encoding):
    with pytest.raises(InvalidInputError, match="expected one of rgb8, bgr8"):
        frame_from_buffer(b"", width=1, height=1, step=3, encoding=encoding)


@pytest.mark.parametrize(
    ("size", "step"),
    [(11, 6), (12, 5), (13, 6), (0, 6), (12, 0)],
    ids=["short", "step", "long", "empty", "zero"],
)
def test_a_buffer_that_does_not_hold_the_rows_is_refused(size, step):
    with pytest.raises(InvalidInputError, match="Image buffer holds"):
        frame_from_buffer(bytes(size), width=2, height=2, step=step, encoding="rgb8")


@pytest.mark.parametrize(("width", "height"), [(0, 1), (1, 0), (9000, 1), (-1, 1)])
def test_an_absurd_size_is_refused(width, height):
    with pytest.raises(InvalidInputError, match="is outside"):
        frame_from_buffer(b"", width=width, height=height, step=27000, encoding="rgb8")


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((2, 2, 3), np.float32),
        np.zeros((2, 2), np.uint8),
        np.zeros((2, 2, 4), np.uint8),
        np.zeros((0, 2, 3), np.uint8),
    ],
)
def test_what_is_no_rgb_image_is_refused(image):
    with pytest.raises(InvalidInputError, match="expected uint8"):
        check_rgb8(image)
    with pytest.raises(InvalidInputError):
        Frame(camera="front", image=image, stamp_ns=1, frame_id="front_optical")


HOLES = [0.0, np.nan, np.inf, -np.inf, -0.2]


@pytest.mark.parametrize("padding", [0, 4])
@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize(
    ("encoding", "dtype", "values", "depth_m"),
    [
        ("16UC1", "u2", [[1, 250, 0], [1000, 65535, 0]], [[0.001, 0.25, 0], [1, 65.535, 0]]),
        (
            "32FC1",
            "f4",
            [[0.4, 1.5, 8.0], HOLES[:3], HOLES[2:]],
            [[0.4, 1.5, 8.0], [0] * 3, [0] * 3],
        ),
    ],
)
def test_depth_is_read_in_metres_with_holes(
    encoding, dtype, values, depth_m, is_bigendian, padding
):
    rows = np.array(values, dtype=(">" if is_bigendian else "<") + dtype)
    data = b"".join(row.tobytes() + bytes(padding) for row in rows)
    message = SimpleNamespace(
        data=data,
        width=3,
        height=len(rows),
        step=3 * rows.dtype.itemsize + padding,
        encoding=encoding,
        is_bigendian=is_bigendian,
    )
    found = depth_from_message(message)
    assert found.dtype == np.float32
    np.testing.assert_allclose(np.nan_to_num(found), depth_m, rtol=1e-6)
    assert np.isnan(found).sum() == np.sum(np.array(depth_m) == 0)


@pytest.mark.parametrize(
    ("encoding", "size", "step", "match"),
    [
        ("rgb8", 12, 6, "no depth"),
        ("mono16", 8, 4, "no depth"),
        ("64FC1", 32, 16, "no depth"),
        ("16UC1", 7, 4, "holds"),
        ("16UC1", 8, 3, "holds"),
        ("32FC1", 8, 8, "holds"),
        ("32FC1", 0, 0, "holds"),
    ],
)
def test_what_is_no_depth_is_refused(encoding, size, step, match):
    message = SimpleNamespace(
        data=bytes(size), width=2, height=2, step=step, encoding=encoding, is_bigendian=False
    )
    with pytest.raises(InvalidInputError, match=match):
        depth_from_message(message)


@pytest.mark.parametrize(
    "depth_m", [np.zeros((2, 3), np.float32), np.zeros((2, 2)), np.zeros((2, 2, 1), np.float32)]
)
def test_depth_of_another_form_than_its_picture_is_refused(depth_m):
    image = np.zeros((2, 2, 3), np.uint8)
    with pytest.raises(InvalidInputError, match="depth"):
        Frame(camera="front", image=image, stamp_ns=1, frame_id="front", depth_m=depth_m)
