"""Absent drivers, other types, unknown encodings, bad stamps and calibrations: which one, and what
to do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from rn_perception_camera.options import RosCamerasOptions
from rn_perception_camera.ros_source import RosCameras
from roboneuron.errors import ConfigurationError, InvalidInputError, NotReadyError, StateError

NOW_NS = 1_700_000_000_000_000_000


def test_topic_without_publisher_is_named(cell: Any) -> None:
    source = cell.source(front={"topic": "/usb/image_raw"})
    with pytest.raises(
        NotReadyError, match=r"Nobody publishes images of camera 'front' on topic '/usb/image_raw'"
    ):
        source.read(0.01)


def test_publisher_that_is_silent_is_told_from_an_absent_one(cell: Any) -> None:
    cell.topics.advertise("front", Image)
    source = cell.source(front={})
    with pytest.raises(NotReadyError, match="has a publisher, but nothing new came"):
        source.read(0.01)


@pytest.mark.parametrize(
    ("transport", "kind", "advice"),
    [("raw", CompressedImage, "compressed"), ("compressed", Image, "raw")],
)
def test_other_transport_is_refused_with_the_right_one(
    cell: Any, transport: str, kind: Any, advice: str
) -> None:
    cell.topics.advertise("front", kind)
    with pytest.raises(
        ConfigurationError, match=f'carries sensor_msgs/msg/{kind.__name__}.*transport = "{advice}"'
    ):
        cell.source(front={"transport": transport})


def test_type_that_shows_only_later_is_refused_in_read(cell: Any) -> None:
    source = cell.source(front={})
    cell.topics.advertise("front", CameraInfo)
    with pytest.raises(
        ConfigurationError,
        match=r"carries sensor_msgs/msg/CameraInfo, expected sensor_msgs/msg/Image",
    ):
        source.read(0.01)


def test_unknown_encoding_is_refused_with_the_known_ones(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={})
    message = raw(pixels)
    message.encoding = "theora"
    cell.topics.deliver("front", message)
    with pytest.raises(
        InvalidInputError,
        match=r"'front' on topic 'front'.*'theora' cannot be read.*\"compressed\"",
    ):
        source.read(1.0)


@pytest.mark.parametrize("damage", ["cut", "noise", "depth", "deep"])
def test_damaged_compressed_images_are_refused(
    cell: Any, compressed: Any, pixels: Any, damage: str
) -> None:
    source = cell.source(front={"transport": "compressed"})
    message = compressed(pixels, mode="I;16" if damage == "deep" else "RGB")
    if damage == "cut":
        message.data = message.data[: len(message.data) // 2]
    elif damage == "noise":
        message.data = message.data[::-1]
    elif damage == "depth":
        message.format = "16UC1; compressedDepth"
    cell.topics.deliver("front", message)
    with pytest.raises(InvalidInputError, match="camera 'front' on topic 'front' cannot be used"):
        source.read(1.0)


@pytest.mark.parametrize(
    ("at_ns", "words"),
    [
        (0, "no capture time"),
        (NOW_NS - 60 * 10**9, "60.0 s behind"),
        (NOW_NS + 60 * 10**9, "60.0 s ahead of"),
    ],
)
def test_bad_stamps_are_refused_unless_arrival_is_asked_for(
    cell: Any, raw: Any, pixels: Any, at_ns: int, words: str
) -> None:
    source = cell.source(front={})
    cell.topics.deliver("front", raw(pixels, at_ns))
    with pytest.raises(InvalidInputError, match=f'{words}.*stamp = "arrival"'):
        source.read(1.0)


def test_images_wait_for_their_calibration(cell: Any, raw: Any, info: Any, pixels: Any) -> None:
    source = cell.source(front={"camera_info": "info"})
    cell.topics.advertise("front", Image)
    cell.topics.deliver("front", raw(pixels))
    with pytest.raises(
        NotReadyError, match="wait for their calibration on topic 'info', which nobody publishes"
    ):
        source.read(0.01)
    cell.topics.deliver("info", info())
    cell.topics.deliver("front", raw(pixels))
    assert source.read(1.0).calibration is not None


def _uncalibrated(message: CameraInfo) -> None:
    message.k = [0.0] * 9


def _binned(message: CameraInfo) -> None:
    message.binning_x = 2


def _cropped(message: CameraInfo) -> None:
    message.roi.x_offset = 8


def _distorted(message: CameraInfo) -> None:
    message.d = [-0.3, 0.1, 0.0, 0.0, 0.0]


def _sized(message: CameraInfo) -> None:
    message.width = 640


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_uncalibrated, "holds no calibration"),
        (_binned, "part of the sensor"),
        (_cropped, "part of the sensor"),
        (_distorted, r'lens distorts .*distortion = "undistort"'),
        (_sized, "describes 640x48 images, they are 64x48"),
    ],
)
def test_calibrations_that_do_not_hold_are_refused(
    cell: Any, raw: Any, info: Any, pixels: Any, change: Any, words: str
) -> None:
    source = cell.source(front={"camera_info": "info"})
    message = info()
    change(message)
    cell.topics.deliver("info", message)
    cell.topics.deliver("front", raw(pixels))
    with pytest.raises(
        ConfigurationError, match=f"camera 'front' on topic 'info' cannot be used. .*{words}"
    ):
        source.read(1.0)


def test_unknown_distortion_model_is_refused(cell: Any, raw: Any, info: Any, pixels: Any) -> None:
    source = cell.source(front={"camera_info": "info", "distortion": "undistort"})
    cell.topics.deliver("info", info(model="thin_prism", d=(0.1,) * 5))
    cell.topics.deliver("front", raw(pixels))
    with pytest.raises(
        ConfigurationError, match=r"'thin_prism' with 5 coefficients is not known.*plumb_bob"
    ):
        source.read(1.0)


def test_camera_info_is_of_no_use_without_a_mount(cell: Any) -> None:
    with pytest.raises(ConfigurationError, match="does not tell where it is mounted"):
        cell.source(calibrated=False, front={"camera_info": "info"})
    cell.source(calibrated=False, front={"camera_info": "info", "distortion": "undistort"})


def test_camera_without_options_is_named(cell: Any, profile: Any) -> None:
    config = RosCamerasOptions.model_validate({"cameras": {"frnt": {"topic": "/a"}}})
    source = RosCameras(config, cell.topics, [profile("front")])
    with pytest.raises(
        ConfigurationError,
        match=r"\[plugins.ros-camera.cameras.front\]; there are tables for: 'frnt'",
    ):
        source.open()


def test_read_in_progress_ends_when_the_source_is_closed(cell: Any) -> None:
    import threading

    source = cell.source(front={})
    timer = threading.Timer(0.05, source.close)
    timer.start()
    with pytest.raises(StateError):
        source.read(5.0)
    timer.join()


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"distortion": "undistort"}, "needs camera_info"),
        ({"resize": {"width": 8, "height": 8}}, "fit"),
        ({"resize": {"width": 8, "height": 8, "fit": "stretch"}}, "letterbox"),
        ({"max_rate_hz": 0.0}, "greater than 0"),
    ],
)
def test_options_that_make_no_sense_are_refused(table: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        RosCamerasOptions.model_validate({"cameras": {"front": {"topic": "/a", **table}}})


def test_frames_of_padded_images_do_not_share_the_buffer(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={})
    frames = []
    for turn in range(2):
        cell.topics.deliver("front", raw(pixels, NOW_NS + turn, padding=4))
        frames.append(source.read(1.0))
    assert not np.shares_memory(frames[0].image, frames[1].image)
