"""Images are parsed, and message definitions complete, without ROS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recorder_rig import START_NS

from rn_recorder_runs.files import (
    Record,
    RunFile,
)
from rn_recorder_runs.images import IMAGE, MessageError, parse_image
from rn_recorder_runs.reading import RecordDecoder, iterate
from rn_recorder_runs.schemas import definition


@pytest.fixture
def image_message() -> tuple[bytes, np.ndarray]:
    from rclpy.serialization import serialize_message

    from roboneuron import Frame
    from roboneuron.ros.messages import to_image

    ramp = np.linspace(0, 255, 64 * 48 * 3).astype(np.uint8).reshape(48, 64, 3)
    frame = Frame(camera="front", image=ramp, stamp_ns=START_NS + 5, frame_id="front_optical")
    return bytes(serialize_message(to_image(frame))), ramp


def test_images_are_read_and_encoded_without_ros(
    image_message: tuple[bytes, np.ndarray], tmp_path: Path
) -> None:
    from rn_recorder_runs.images import COMPRESSED, pixels_of, to_jpeg

    message, ramp = image_message
    raw = parse_image(message)
    assert (raw.stamp_ns, raw.width, raw.height, raw.frame_id) == (
        START_NS + 5,
        64,
        48,
        b"front_optical",
    )
    encoded = to_jpeg(message, 95)
    assert encoded is not None
    with pytest.raises(MessageError):
        parse_image(message[:100])
    path = tmp_path / "images.mcap"
    file = RunFile(path, {})
    file.write(Record("/camera/front/image", IMAGE, START_NS, START_NS, 1, message))
    file.write(Record("/camera/front/image/compressed", COMPRESSED, START_NS, START_NS, 1, encoded))
    file.finish()
    whole, small = (found for found in iterate([path], lambda topic: True))
    np.testing.assert_array_equal(pixels_of(whole.message, IMAGE), ramp)
    decoded = pixels_of(small.message, COMPRESSED)
    assert np.abs(decoded.astype(int) - ramp).mean() < 6  # what JPEG takes from a steep ramp
    assert small.message.header.frame_id == "front_optical"
    assert small.message.format == "rgb8; jpeg compressed bgr8"


@pytest.mark.parametrize(
    "name",
    [
        "sensor_msgs/msg/Image",
        "diagnostic_msgs/msg/DiagnosticArray",
        "trajectory_msgs/msg/JointTrajectory",
    ],
)
def test_definitions_are_complete(name: str) -> None:
    from importlib import import_module

    from rclpy.serialization import serialize_message

    package, kind, short = name.split("/")
    message = getattr(import_module(f"{package}.{kind}"), short)()
    message.header.frame_id = "base"
    decoder = RecordDecoder()
    decoder.definitions[name] = definition(name)
    decoded = decoder.decode(Record("/t", name, 0, 0, 0, bytes(serialize_message(message))))
    assert decoded.header.frame_id == "base"
