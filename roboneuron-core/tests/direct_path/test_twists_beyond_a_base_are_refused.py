"""What a mobile base can be asked to do, told by its endpoint."""

from __future__ import annotations

import math

import pytest

from roboneuron.contract import Endpoint
from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.limits import check_steering
from roboneuron.direct_path.twists import TWIST_FIELDS, check_twist
from roboneuron.errors import RefusedError

CAR = Endpoint(
    name="velocity",
    kind="publish",
    topic="cmd_vel",
    type="geometry_msgs/msg/Twist",
    summary="Drive.",
    bounds=dict.fromkeys(TWIST_FIELDS, (0.0, 0.0))
    | {"linear.x": (-1.0, 2.0), "angular.z": (-1.5, 1.5)},
    min_turning_radius_m=0.5,
)


@pytest.mark.parametrize(
    ("linear", "angular"),
    [(0.0, 0.0), (2.0, 1.5), (-1.0, 1.5), (0.5, 1.0), (0.1, -0.2), (1.0, 0.0)],
)
def test_a_possible_twist_passes(linear: float, angular: float) -> None:
    check_twist(CAR, {"linear.x": linear, "angular.z": angular})


@pytest.mark.parametrize(
    ("twist", "reason"),
    [
        ({"linear.x": math.nan}, "linear.x is nan"),
        ({"angular.z": -math.inf}, "angular.z is -inf"),
        ({"linear.x": 2.001}, r"linear.x is 2.001, expected -1 .. 2"),
        ({"linear.x": 1e308}, "beyond the limits"),
        ({"linear.y": 0.1}, "linear.y is 0.1, expected 0"),
        ({"angular.z": 0.4}, "cannot turn on the spot"),
        ({"linear.x": 0.5, "angular.z": 1.2}, r"radius 0.417 m, expected at least 0.5 m"),
    ],
)
def test_an_impossible_twist_is_refused_with_the_reason(
    twist: dict[str, float], reason: str
) -> None:
    with pytest.raises(RefusedError, match=reason):
        check_twist(CAR, twist)


def test_the_hint_of_a_refused_turn_is_possible() -> None:
    with pytest.raises(RefusedError, match="1 rad/s") as refusal:
        check_twist(CAR, {"linear.x": 0.5, "angular.z": 1.4})
    assert "Turn at 1 rad/s" in refusal.value.hint
    check_twist(CAR, {"linear.x": 0.5, "angular.z": 1.0})


def test_the_steering_of_a_message_is_judged_by_its_turn_alone() -> None:
    """Its bounds have been applied before, to each field by its own path."""
    message = load_type("geometry_msgs/msg/Twist")()
    message.linear.x, message.angular.z = 3.0, 6.0
    check_steering(CAR, message)
    message.angular.z = 6.1
    with pytest.raises(RefusedError, match="the steering ends there"):
        check_steering(CAR, message)
