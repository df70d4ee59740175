"""Images that are fields of messages of other types, by the field's path."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from sensor_msgs.msg import Image
from stereo_msgs.msg import DisparityImage
from visualization_msgs.msg import Marker, MarkerArray

from rn_perception_camera.options import RosCameraOptions
from roboneuron.errors import ConfigurationError, InvalidInputError

DISPARITY = "stereo_msgs/msg/DisparityImage"
MARKERS = {
    "type": "visualization_msgs/msg/MarkerArray",
    "field": "markers[1].texture",
    "transport": "compressed",
}


def test_a_raw_image_in_a_message_becomes_a_frame(cell: Any, raw: Any, pixels: Any) -> None:
    source = cell.source(front={"type": DISPARITY, "field": "image"})
    cell.topics.deliver("front", DisparityImage(image=raw(pixels)))
    frame = source.read(1.0)
    np.testing.assert_array_equal(frame.image, pixels)
    assert frame.frame_id == "driver_optical"


def test_a_compressed_image_in_an_entry_becomes_a_frame(
    cell: Any, compressed: Any, pixels: Any
) -> None:
    source = cell.source(front=MARKERS)
    markers = [Marker(), Marker(texture=compressed(pixels))]
    cell.topics.deliver("front", MarkerArray(markers=markers))
    np.testing.assert_array_equal(source.read(1.0).image, pixels)


def test_an_entry_that_is_not_there_is_told_and_the_next_message_comes(
    cell: Any, compressed: Any, pixels: Any
) -> None:
    source = cell.source(front=MARKERS)
    cell.topics.deliver("front", MarkerArray(markers=[Marker()]))
    with pytest.raises(InvalidInputError, match=r"'markers\[1\].texture'.*has 1 entries"):
        source.read(1.0)
    markers = [Marker(), Marker(texture=compressed(pixels))]
    cell.topics.deliver("front", MarkerArray(markers=markers))
    assert source.read(1.0).camera == "front"


@pytest.mark.parametrize(
    ("name", "field", "words"),
    [
        (DISPARITY, "picture", "does not exist: .*DisparityImage has .*image"),
        (DISPARITY, "header", "is a std_msgs/msg/Header, expected sensor_msgs/msg/Image"),
        (DISPARITY, "f", "is a float, expected"),
        (DISPARITY, "f.x", "goes on below a float"),
        (DISPARITY, "image[0]", "is no array, so it is written image"),
        (MARKERS["type"], "markers.texture", r"is an array, so it is written markers\[0\]"),
        (MARKERS["type"], "markers[0].texture", "is a sensor_msgs/msg/CompressedImage, expected"),
        ("nobody_msgs/msg/Views", "image", "nobody_msgs/msg/Views is unknown here"),
        ("sensor_msgs/msg/Views", "image", "sensor_msgs/msg/Views is unknown here"),
    ],
)
def test_what_leads_to_no_image_is_refused(cell: Any, name: str, field: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        cell.source(front={"type": name, "field": field})


@pytest.mark.parametrize(
    "options",
    [
        {"type": DISPARITY},
        {"field": "image"},
        {"type": "stereo_msgs/DisparityImage", "field": "image"},
        {"type": DISPARITY, "field": "__class__"},
        {"type": DISPARITY, "field": "image."},
        {"type": DISPARITY, "field": "image[-1]"},
    ],
)
def test_options_that_are_no_type_and_field_are_refused(options: dict[str, str]) -> None:
    with pytest.raises(ValidationError):
        RosCameraOptions.model_validate({"topic": "front", **options})


def test_a_topic_of_another_type_is_refused_with_the_way_out(cell: Any) -> None:
    cell.topics.advertise("front", DisparityImage)
    with pytest.raises(ConfigurationError, match="carries stereo_msgs") as refused:
        cell.source(front={})
    assert "set type and field" in str(refused.value.hint)
    cell.topics.advertise("hand", Image)
    with pytest.raises(ConfigurationError, match="carries sensor_msgs/msg/Image, expected stereo_"):
        cell.source(hand={"type": DISPARITY, "field": "image"})
