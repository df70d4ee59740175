"""Goals and messages that say where to go: the frame has to be that of the limits, and no place may
be in a zone, at whatever depth it stands in the message.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import Endpoint, Obstacle
from roboneuron.direct_path.exposed import tightened_by
from roboneuron.direct_path.fields import filled, load_type
from roboneuron.direct_path.limits import check_endpoint
from roboneuron.direct_path.places import check_places, check_way
from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.gate.motion.path_limits import LimitError
from roboneuron.tools.ros.tightening import ConfiguredLimits, tighten

STAIRS = Obstacle(
    name="stairs", lower_m=np.array([1.0, -1.0, -1.0]), upper_m=np.array([2.0, 1.0, 1.0])
)
PIT = Obstacle(name="pit", lower_m=np.array([5.0, 5.0, -1.0]), upper_m=np.array([6.0, 6.0, 1.0]))


def endpoint(name: str = "PoseStamped", package: str = "geometry_msgs", **more: Any) -> Endpoint:
    return Endpoint(
        name="goal",
        kind="publish",
        topic="goal",
        type=f"{package}/msg/{name}",
        summary="x",
        **{"frame": "map", "zones": (STAIRS,), **more},
    )


def pose(x: float, y: float = 0.0, frame: str = "map", w: float = 1.0) -> dict[str, Any]:
    return {
        "header": {"frame_id": frame},
        "pose": {"position": {"x": x, "y": y}, "orientation": {"w": w}},
    }


def made(name: str, values: dict[str, Any]) -> Any:
    return filled(load_type(name), values)


POSE = "geometry_msgs/msg/PoseStamped"


@pytest.mark.parametrize("x", [0.0, 0.999, 2.001, -50.0])
def test_a_place_outside_every_zone_passes(x: float) -> None:
    check_places(endpoint(), made(POSE, pose(x)))


@pytest.mark.parametrize(("x", "y"), [(1.0, 0.0), (1.5, 0.99), (2.0, -1.0)])
def test_a_place_in_a_zone_is_refused_by_its_name(x: float, y: float) -> None:
    with pytest.raises(LimitError, match="is in the zone 'stairs'") as refusal:
        check_places(endpoint(), made(POSE, pose(x, y)))
    assert refusal.value.limit == "zone"


@pytest.mark.parametrize("frame", ["odom", "", "/map"])
def test_another_frame_is_refused(frame: str) -> None:
    """The numbers of a zone mean nothing in it."""
    with pytest.raises(LimitError, match="expected 'map'") as refusal:
        check_places(endpoint(), made(POSE, pose(0.0, frame=frame)))
    assert refusal.value.limit == "frame"


@pytest.mark.parametrize("w", [0.0, 0.9, 2.0])
def test_a_rotation_that_is_none_is_refused(w: float) -> None:
    with pytest.raises(LimitError, match=r"pose.orientation has the length .*, expected 1"):
        check_places(endpoint(), made(POSE, pose(0.0, w=w)))


def test_every_place_of_a_list_is_judged() -> None:
    path = load_type("nav_msgs/msg/Path")(poses=[made(POSE, pose(0.0)), made(POSE, pose(1.5))])
    with pytest.raises(LimitError, match=r"poses\[1\] \(1.50, 0.00, 0.00\) is in the zone"):
        check_places(endpoint("Path", "nav_msgs"), path)


def test_a_point_is_a_place() -> None:
    values = {"header": {"frame_id": "map"}, "point": {"x": 1.5}}
    point = made("geometry_msgs/msg/PointStamped", values)
    with pytest.raises(LimitError, match="stairs"):
        check_places(endpoint("PointStamped"), point)


def test_an_endpoint_without_a_frame_takes_places_in_any() -> None:
    check_places(endpoint(frame="", zones=()), made(POSE, pose(1.5, frame="odom", w=0.0)))


def test_feedback_from_a_zone_is_a_violation_and_that_of_other_frames_is_not() -> None:
    with pytest.raises(RefusedError, match="has come into the zone 'stairs'"):
        check_way(endpoint(), made(POSE, pose(1.5)))
    check_way(endpoint(), made(POSE, pose(1.5, frame="odom")))
    check_way(endpoint(), made(POSE, pose(0.5)))
    check_way(endpoint(), made(POSE, pose(math.nan)))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (endpoint("Twist"), "sends no place"),
        (endpoint(frame=""), "has zones and no frame"),
        (endpoint(zones=(replace(STAIRS, upper_m=np.zeros(3)),)), "'stairs' are swapped"),
    ],
)
def test_limits_of_place_that_mean_nothing_are_refused(wrong: Endpoint, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        check_endpoint(wrong)


def test_a_configuration_adds_zones_and_keeps_the_frame() -> None:
    tight = tighten(endpoint(), ConfiguredLimits(zones=(PIT,)))
    assert [zone.name for zone in tight.zones] == ["stairs", "pit"]
    assert tight.frame == "map"
    with pytest.raises(ConfigurationError, match=r"in\s+'map'|in 'map'"):
        tighten(endpoint(), ConfiguredLimits(frame="odom"))


def test_two_names_of_a_topic_share_their_zones() -> None:
    both = tightened_by(endpoint(), endpoint(zones=(PIT,)))
    assert {zone.name for zone in both.zones} == {"stairs", "pit"}
    with pytest.raises(ConfigurationError, match="limits of place in 'odom' and in 'map'"):
        tightened_by(endpoint(), endpoint(frame="odom"))
