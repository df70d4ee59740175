"""Images on topics in memory, read as frames: pixels, stamps, turns, rates and calibrations."""

from __future__ import annotations

import array
import time
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import Image

from rn_perception_camera.options import RosCameraOptions
from roboneuron.errors import InvalidInputError, NotReadyError

NOW_NS = 1_700_000_000_000_000_000


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8"])
@pytest.mark.parametrize("padding", [0, 7])
def test_colour_images_keep_every_pixel(
    cell: Any, raw: Any, pixels: Any, encoding: str, padding: int
) -> None:
    source = cell.source(front={})
    cell.topics.deliver("front", raw(pixels, encoding=encoding, padding=padding))
    np.testing.assert_array_equal(source.read(1.0).image, pixels)


def test_grey_images_become_grey_rgb(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={})
    cell.topics.deliver("front", raw(pixels, encoding="mono8"))
    np.testing.assert_array_equal(source.read(1.0).image, np.repeat(pixels[:, :, :1], 3, axis=2))


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_png_images_keep_every_pixel(cell: Any, compressed: Any, pixels: Any, mode: str) -> None:
    source = cell.source(front={"transport": "compressed"})
    cell.topics.deliver("front", compressed(pixels, mode=mode))
    np.testing.assert_array_equal(source.read(1.0).image, pixels)


def test_jpeg_images_keep_their_colours(cell: Any, compressed: Any) -> None:
    red = np.full((48, 64, 3), (220, 40, 10), dtype=np.uint8)
    source = cell.source(front={"transport": "compressed"})
    cell.topics.deliver("front", compressed(red, form="jpeg"))
    image = source.read(1.0).image
    assert np.abs(image.astype(int) - red).max() <= 3  # JPEG at quality 75, one colour


def test_capture_stamps_and_frame_ids_are_the_drivers(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={})
    cell.topics.deliver("front", raw(pixels, NOW_NS - 123_456_789))
    frame = source.read(1.0)
    assert (frame.stamp_ns, frame.frame_id) == (NOW_NS - 123_456_789, "driver_optical")


def test_frame_id_of_the_profile_when_asked_for_or_when_the_driver_has_none(
    cell: Any, raw: Any, pixels: Any
) -> None:
    source = cell.source(front={"frame_id": "profile"}, hand={})
    cell.topics.deliver("front", raw(pixels))
    assert source.read(1.0).frame_id == "front_optical"
    nameless = raw(pixels)
    nameless.header.frame_id = ""
    cell.topics.deliver("hand", nameless)
    assert source.read(1.0).frame_id == "hand_optical"


def test_arrival_stamps_need_no_capture_stamps(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={"stamp": "arrival"})
    cell.topics.deliver("front", raw(pixels, 0))
    assert source.read(1.0).stamp_ns == NOW_NS


def test_newest_image_wins_and_older_ones_are_not_delivered(
    cell: Any, raw: Any, pixels: Any
) -> None:
    source = cell.source(front={})
    for later_ns in (1, 2, 3):
        cell.topics.deliver("front", raw(pixels, NOW_NS + later_ns))
    assert source.read(1.0).stamp_ns == NOW_NS + 3
    for earlier_ns in (3, 2):
        cell.topics.deliver("front", raw(pixels, NOW_NS + earlier_ns))
        with pytest.raises(NotReadyError):
            source.read(0.01)


def test_images_go_on_after_the_clock_was_set_back(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={})
    cell.topics.deliver("front", raw(pixels))
    source.read(1.0)
    cell.now_ns = NOW_NS - 3600 * 10**9
    cell.topics.deliver("front", raw(pixels, cell.now_ns))
    assert source.read(1.0).stamp_ns == cell.now_ns


def test_busy_camera_does_not_starve_the_other(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={}, hand={})
    seen = []
    for turn in range(6):
        for name in ("hand", "front"):
            cell.topics.deliver(name, raw(pixels, NOW_NS + turn))
        seen.append(source.read(1.0).camera)
    assert seen.count("front") == seen.count("hand") == 3


def test_max_rate_holds_the_newest_image_until_it_is_due(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={"max_rate_hz": 10.0})
    began_s = time.monotonic()
    for turn in range(3):
        cell.topics.deliver("front", raw(pixels, NOW_NS + 2 * turn))
        cell.topics.deliver("front", raw(pixels, NOW_NS + 2 * turn + 1))
        assert source.read(1.0).stamp_ns == NOW_NS + 2 * turn + 1
    assert time.monotonic() - began_s >= 0.2


def test_image_that_is_not_due_is_told_from_an_absent_one(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={"max_rate_hz": 0.1})
    cell.topics.deliver("front", raw(pixels))
    source.read(1.0)
    cell.topics.deliver("front", raw(pixels, NOW_NS + 1))
    with pytest.raises(NotReadyError, match="not due yet"):
        source.read(0.01)


def test_camera_info_gives_the_intrinsics_and_the_profile_the_mount(
    cell: Any, raw: Any, info: Any, pixels: Any, profile: Any
) -> None:
    source = cell.source(front={"camera_info": "info"})
    cell.topics.deliver("info", info())
    cell.topics.deliver("front", raw(pixels))
    calibration = source.read(1.0).calibration
    # the contract's pixel centres are at integers + 0.5, ROS' at integers
    np.testing.assert_array_equal(calibration.intrinsics, [[50, 0, 30.5], [0, 51, 20.5], [0, 0, 1]])
    mounted = profile("front").calibration
    assert calibration.mount == mounted.mount
    np.testing.assert_array_equal(calibration.T_mount_camera, mounted.T_mount_camera)


def test_rectified_topics_take_the_projection(cell: Any, raw: Any, info: Any, pixels: Any) -> None:
    source = cell.source(front={"camera_info": "info", "distortion": "rectified"})
    cell.topics.deliver("info", info(d=(-0.3, 0.1, 0.0, 0.0, 0.0)))
    cell.topics.deliver("front", raw(pixels))
    frame = source.read(1.0)
    np.testing.assert_array_equal(
        frame.calibration.intrinsics, [[40, 0, 31.5], [0, 41, 21.5], [0, 0, 1]]
    )
    np.testing.assert_array_equal(frame.image, pixels)


def test_without_camera_info_the_profile_calibrates_images_of_its_shape(
    cell: Any, raw: Any, profile: Any
) -> None:
    source = cell.source(front={})
    cell.topics.deliver("front", raw(np.zeros((96, 128, 3), dtype=np.uint8)))
    intrinsics = source.read(1.0).calibration.intrinsics
    np.testing.assert_allclose(intrinsics[:2], 2 * profile("front").calibration.intrinsics[:2])
    cell.topics.deliver("front", raw(np.zeros((96, 96, 3), dtype=np.uint8), NOW_NS + 1))
    assert source.read(1.0).calibration is None


def test_calibration_follows_the_driver(cell: Any, raw: Any, info: Any, pixels: Any) -> None:
    source = cell.source(front={"camera_info": "info"})
    for turn, focal_px in enumerate((50.0, 70.0)):
        message = info()
        message.k[0] = focal_px
        cell.topics.deliver("info", message)
        cell.topics.deliver("front", raw(pixels, NOW_NS + turn))
        assert source.read(1.0).calibration.intrinsics[0, 0] == focal_px


def depth_of(pixels: Any, at_ns: int = NOW_NS, encoding: str = "16UC1") -> Any:
    """Depth of an image as a driver sends it: 0.5 m, a hole in the first column."""
    height, width = pixels.shape[:2]
    values = np.full((height, width), 500 if encoding == "16UC1" else 0.5)
    values[:, 0] = 0
    data = values.astype("<u2" if encoding == "16UC1" else "<f4")
    message = Image(
        width=width,
        height=height,
        step=data.nbytes // height,
        encoding=encoding,
        data=array.array("B", data.tobytes()),
    )
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(at_ns, 10**9)
    return message


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
@pytest.mark.parametrize("first", ["image", "depth"])
def test_an_image_has_the_depth_of_its_time(
    cell: Any, raw: Any, pixels: Any, encoding: str, first: str
) -> None:
    source = cell.source(front={"depth": "depth"})
    arriving = [("front", raw(pixels)), ("depth", depth_of(pixels, NOW_NS + 1_000_000, encoding))]
    for topic, message in arriving if first == "image" else reversed(arriving):
        cell.topics.deliver(topic, message)
    depth_m = source.read(1.0).depth_m
    assert np.isnan(depth_m[:, 0]).all()
    assert (depth_m[:, 1:] == 0.5).all()


def test_an_image_whose_depth_is_lost_comes_with_the_next(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={"depth": "depth"})
    cell.topics.deliver("front", raw(pixels))
    with pytest.raises(NotReadyError):
        source.read(0.0)
    cell.topics.deliver("depth", depth_of(pixels, NOW_NS - 30_000_000))
    cell.topics.deliver("front", raw(pixels, NOW_NS + 30_000_000))
    frame = source.read(1.0)
    assert (frame.stamp_ns, frame.depth_m) == (NOW_NS, None)
    cell.topics.deliver("depth", depth_of(pixels, NOW_NS + 30_000_000))
    assert source.read(1.0).depth_m is not None


@pytest.mark.parametrize("fit", ["letterbox", "crop"])
def test_depth_is_fitted_like_its_image(cell: Any, raw: Any, pixels: Any, fit: str) -> None:
    source = cell.source(
        front={"depth": "depth", "resize": {"width": 32, "height": 32, "fit": fit}}
    )
    pixels[:] = 255
    cell.topics.deliver("front", raw(pixels))
    cell.topics.deliver("depth", depth_of(pixels))
    frame = source.read(1.0)
    is_seen = frame.image.any(axis=2)
    is_seen[:, 0] = False  # of the hole
    known = np.isfinite(frame.depth_m)
    assert (known[:, 1:] == is_seen[:, 1:]).all()
    assert set(frame.depth_m[known].tolist()) == {0.5}


@pytest.mark.parametrize(
    ("shape", "encoding"), [((24, 32, 3), "16UC1"), ((48, 64, 3), "rgb8")], ids=["size", "encoding"]
)
def test_depth_that_does_not_fit_is_refused(
    cell: Any, raw: Any, pixels: Any, shape: Any, encoding: str
) -> None:
    source = cell.source(front={"depth": "depth"})
    cell.topics.deliver("front", raw(pixels))
    message = depth_of(np.zeros(shape, np.uint8))
    message.encoding = encoding
    cell.topics.deliver("depth", message)
    with pytest.raises(InvalidInputError, match="depth"):
        source.read(1.0)


def test_depth_of_an_undistorted_image_is_refused() -> None:
    with pytest.raises(ValueError, match="registered"):
        RosCameraOptions(topic="a", camera_info="b", depth="c", distortion="undistort")
