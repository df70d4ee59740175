"""What an agent sees of large messages: summaries, pictures, names of constants; always valid
JSON.
"""

from __future__ import annotations

import io
import json
import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as PillowImage

from roboneuron.errors import InvalidInputError
from roboneuron.tools.ros.interfaces import DecodeLimits, list_interfaces, load_message


def build(name: str, value: Any, **kwargs: Any) -> tuple[Any, Any]:
    part = load_message(name, **kwargs)
    return part, part.encode(value, now_ns=0)


def test_long_arrays_become_a_summary() -> None:
    part, message = build(
        "std_msgs/msg/Float64MultiArray", {"data": [float(i) for i in range(1000)]}
    )
    summary = part.decode(message)["data"]
    assert summary == {
        "length": 1000,
        "min": 0.0,
        "max": 999.0,
        "mean": 499.5,
        "first": [float(i) for i in range(8)],
    }
    assert part.decode(message, DecodeLimits(items=1000))["data"] == [float(i) for i in range(1000)]


def test_summaries_count_what_is_not_finite() -> None:
    part, message = build(
        "std_msgs/msg/Float64MultiArray", {"data": [1.0] * 80 + ["NaN"]}, nonfinite=frozenset({"*"})
    )
    summary = part.decode(message)["data"]
    assert summary["nonfinite"] == 1
    assert summary["max"] == 1.0
    json.dumps(part.decode(message), allow_nan=False)


def test_long_lists_of_messages_text_and_octets_are_shortened() -> None:
    part, message = build("nav_msgs/msg/Path", {"poses": [{}] * 100})
    poses = part.decode(message)["poses"]
    assert (poses["length"], len(poses["first"])) == (100, 8)
    part, message = build("std_msgs/msg/String", {"data": "x" * 3000})
    assert part.decode(message)["data"] == {"length": 3000, "first": "x" * 2000}
    part, message = build("std_msgs/msg/ByteMultiArray", {"data": list(range(100))})
    assert part.decode(message)["data"]["max"] == 99


def test_the_whole_answer_is_bounded() -> None:
    point = {"positions": [0.0] * 30, "velocities": [0.0] * 30}
    part, message = build("trajectory_msgs/msg/JointTrajectory", {"points": [point] * 32})
    assert len(json.dumps(part.decode(message, DecodeLimits(values=100)))) < 12_000
    assert len(json.dumps(part.decode(message))) < 30_000


def test_constants_come_by_name_and_unknown_numbers_stay() -> None:
    part, message = build("sensor_msgs/msg/NavSatStatus", {"status": "STATUS_FIX", "service": 3})
    assert part.decode(message) == {"status": "STATUS_FIX", "service": 3}
    assert part.decode(message, DecodeLimits(names=False))["status"] == 0


def test_float32_is_shown_as_it_was_given() -> None:
    part, message = build("geometry_msgs/msg/Point32", {"x": 0.1})
    assert part.decode(message)["x"] == 0.1


def test_a_scan_says_where_the_nearest_obstacle_is() -> None:
    ranges: list[Any] = [5.0] * 360
    ranges[90], ranges[10], ranges[20] = 0.5, "Infinity", 0.01
    value = {
        "angle_min": -math.pi,
        "angle_increment": math.radians(1),
        "range_min": 0.1,
        "range_max": 10,
        "ranges": ranges,
    }
    part, message = build("sensor_msgs/msg/LaserScan", value, nonfinite=frozenset({"ranges"}))
    seen = part.decode(message)["ranges"]
    assert (seen["beams"], seen["valid"]) == (360, 358)
    assert seen["nearest"]["range_m"] == 0.5
    assert seen["nearest"]["angle_rad"] == pytest.approx(-math.pi / 2, abs=1e-3)
    assert [s["nearest_m"] for s in seen["sectors"]] == [5.0, 5.0, 0.5, 5.0, 5.0, 5.0, 5.0, 5.0]
    json.dumps(part.decode(message), allow_nan=False)


def cloud(points: list[tuple[float, float, float]], **changes: Any) -> dict[str, Any]:
    fields = [
        {"name": n, "offset": 4 * i, "datatype": "FLOAT32", "count": 1} for i, n in enumerate("xyz")
    ]
    data = list(b"".join(struct.pack("<fff", *p) for p in points))
    return {
        "height": 1,
        "width": len(points),
        "fields": fields,
        "point_step": 12,
        "row_step": 12 * len(points),
        "data": data,
        **changes,
    }


def test_a_point_cloud_says_its_extent() -> None:
    part, message = build("sensor_msgs/msg/PointCloud2", cloud([(0, 1, 2), (4, -1, math.nan)]))
    seen = part.decode(message)["data"]
    assert seen["points"] == 2
    assert seen["fields"]["x"] == {"min": 0.0, "max": 4.0, "mean": 2.0}
    assert seen["fields"]["z"]["nonfinite"] == 1


@pytest.mark.parametrize(
    "changes",
    [
        {"point_step": 0},
        {"point_step": 11},
        {"width": 100},
        {"width": 2**32 - 1, "height": 2**32 - 1},
        {"row_step": 1},
        {"data": []},
        {"fields": [{"name": "x", "offset": 2**32 - 1, "datatype": 8}]},
        {"fields": [{"name": "y", "datatype": 99}]},
    ],
)
def test_a_damaged_cloud_is_said_to_be_damaged(changes: dict[str, Any]) -> None:
    part, message = build("sensor_msgs/msg/PointCloud2", cloud([(0, 1, 2), (4, -1, 3)], **changes))
    assert "damaged" in json.dumps(part.decode(message))


def image(encoding: str, pixels: np.ndarray, **changes: Any) -> dict[str, Any]:
    height, width = pixels.shape[:2]
    step = pixels.strides[0]
    return {
        "height": height,
        "width": width,
        "encoding": encoding,
        "step": step,
        "data": list(pixels.tobytes()),
        **changes,
    }


def opened(picture: Any) -> np.ndarray:
    return np.asarray(PillowImage.open(io.BytesIO(picture.data)))


RED = np.zeros((16, 24, 3), np.uint8)
RED[:, :, 0] = 255


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RED),
        ("bgr8", RED[:, :, ::-1].copy()),
        ("rgba8", np.dstack([RED, RED[:, :, 1]])),
        ("8UC3", RED[:, :, ::-1].copy()),
    ],
)
def test_colour_images_come_as_pictures(encoding: str, pixels: np.ndarray) -> None:
    part, message = build("sensor_msgs/msg/Image", image(encoding, pixels))
    assert part.decode(message)["data"] == {"length": pixels.nbytes, "shown_as": "image"}
    (picture,) = part.pictures(message)
    assert (picture.mime_type, picture.width, picture.height, picture.path) == (
        "image/jpeg",
        24,
        16,
        "",
    )
    mean = opened(picture).reshape(-1, 3).mean(axis=0)
    assert mean[0] > 240
    assert mean[1:].max() < 20


@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1", "mono8"])
def test_grey_and_depth_images_come_as_png(encoding: str) -> None:
    dtype = np.float32 if encoding == "32FC1" else np.uint16 if "16" in encoding else np.uint8
    depth = np.linspace(0, 200, 64).reshape(8, 8).astype(dtype)
    if encoding == "32FC1":
        depth[0, 0] = np.nan
    part, message = build("sensor_msgs/msg/Image", image(encoding, depth))
    (picture,) = part.pictures(message)
    assert picture.mime_type == "image/png"
    grey = opened(picture)
    assert grey[0, 1] < grey[7, 7]
    assert bool(picture.note) == (encoding != "mono8")


def test_large_images_are_scaled_down_and_say_so() -> None:
    part, message = build("sensor_msgs/msg/Image", image("mono8", np.zeros((100, 300), np.uint8)))
    (picture,) = part.pictures(message, DecodeLimits(image_side_px=150))
    assert (picture.width, picture.height) == (150, 50)
    assert "300x100" in picture.note


def test_compressed_images_are_shown_and_damaged_ones_refused() -> None:
    buffer = io.BytesIO()
    PillowImage.fromarray(RED).save(buffer, "PNG")
    part, message = build(
        "sensor_msgs/msg/CompressedImage", {"format": "png", "data": list(buffer.getvalue())}
    )
    assert part.pictures(message)[0].width == 24
    part, broken = build(
        "sensor_msgs/msg/CompressedImage", {"format": "png", "data": list(buffer.getvalue()[:60])}
    )
    with pytest.raises(InvalidInputError, match="60 bytes"):
        part.pictures(broken)


@pytest.mark.parametrize(
    "changes",
    [
        {"encoding": "theora"},
        {"data": [0]},
        {"step": 1},
        {"width": 0},
        {"height": 2**32 - 1},
        {"encoding": "32FC1"},
    ],
)
def test_images_that_cannot_be_shown_are_refused_but_still_decoded(changes: dict[str, Any]) -> None:
    part, message = build("sensor_msgs/msg/Image", {**image("rgb8", RED), **changes})
    with pytest.raises(InvalidInputError):
        part.pictures(message)
    json.dumps(part.decode(message))


def test_nested_images_are_found_with_their_path() -> None:
    part, message = build(
        "stereo_msgs/msg/DisparityImage", {"image": image("mono8", np.zeros((4, 4), np.uint8))}
    )
    assert [p.path for p in part.pictures(message)] == ["image"]
    assert part.decode(message)["image"]["data"]["shown_as"] == "image"


def test_another_message_type_is_refused() -> None:
    part, _ = build("std_msgs/msg/String", {"data": ""})
    with pytest.raises(InvalidInputError, match="Empty came where std_msgs/msg/String"):
        part.decode(load_message("std_msgs/msg/Empty").encode({}, now_ns=None))


@pytest.mark.parametrize("examples", [60, pytest.param(300, marks=pytest.mark.exhaustive)])
def test_what_was_decoded_is_json_and_can_be_encoded_again(interface_values, examples: int) -> None:
    @settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    @given(
        seed=st.integers(0, 2**32 - 1),
        name=st.sampled_from([str(n) for n in list_interfaces() if n.kind == "msg"]),
    )
    def check(seed: int, name: str) -> None:
        part = load_message(name)
        value = interface_values.ValueGenerator(seed).value(part.message)
        decoded = part.decode(part.encode(value, now_ns=seed))
        json.dumps(decoded, allow_nan=False)
        if not any(kind in name for kind in ("Image", "PointCloud2", "LaserScan", "Marker")):
            assert part.decode(part.encode(decoded, now_ns=None)) == decoded

    check()
