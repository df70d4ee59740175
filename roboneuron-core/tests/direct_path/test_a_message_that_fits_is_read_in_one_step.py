"""What an endpoint's messages are checked for is made when it is exposed: it decides as the rules
that look at one field after the other, and looks at none where everything fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from roboneuron.contract import Endpoint
from roboneuron.direct_path import limits
from roboneuron.direct_path.fields import filled, has_arrays, load_type
from roboneuron.direct_path.limits import MessageChecks, apply_bounds, check_finite
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.errors import RefusedError

BOUNDS = {
    "geometry_msgs/msg/Twist": {"linear.x": (-0.5, 0.5), "angular.z": (-1.0, 1.0)},
    "geometry_msgs/msg/TwistStamped": {"twist.linear.x": (-0.5, 0.5)},
    "std_msgs/msg/Float64": {"data": (0.0, 1.0)},
    "std_msgs/msg/Int32": {"data": (0, 3)},
    "std_msgs/msg/Float64MultiArray": {"data": (-1.0, 1.0)},
    "geometry_msgs/msg/PoseArray": {"poses.position.x": (0.0, 1.0)},
}
VALUES = [
    ("geometry_msgs/msg/Twist", {"linear": {"x": 0.5}, "angular": {"z": -1.0}}),
    ("geometry_msgs/msg/Twist", {"linear": {"x": 0.6}, "angular": {"z": -1.1}}),
    ("geometry_msgs/msg/Twist", {"linear": {"y": math.nan}}),
    ("geometry_msgs/msg/Twist", {"linear": {"x": math.nan}}),
    ("geometry_msgs/msg/TwistStamped", {"twist": {"linear": {"x": -0.6}}}),
    ("geometry_msgs/msg/TwistStamped", {"twist": {"angular": {"x": math.inf}}}),
    ("std_msgs/msg/Float64", {"data": 1.5}),
    ("std_msgs/msg/Float64", {"data": -math.inf}),
    ("std_msgs/msg/Int32", {"data": 4}),
    ("std_msgs/msg/Float64MultiArray", {"data": [0.0, 2.0, -3.0]}),
    ("std_msgs/msg/Float64MultiArray", {"data": [0.0, math.nan]}),
    ("geometry_msgs/msg/PoseArray", {"poses": [{}, {"position": {"x": 2.0}}]}),
]


def allowed(type_name: str, clamp: bool) -> AllowedEndpoint:
    bounds: dict[str, Any] = BOUNDS[type_name]
    endpoint = Endpoint(
        name="it", kind="publish", topic="it", type=type_name, summary="it", bounds=bounds
    )
    return AllowedEndpoint(
        robot="arm", endpoint=endpoint, clamp=frozenset(bounds) if clamp else frozenset()
    )


def outcome(work: Callable[[], Any]) -> Any:
    try:
        return work()
    except RefusedError as error:
        return str(error)


@pytest.mark.parametrize("clamp", [False, True])
@pytest.mark.parametrize(("type_name", "value"), VALUES)
def test_it_decides_as_the_rules_for_single_fields(
    type_name: str, value: dict[str, Any], clamp: bool
) -> None:
    entry, ros_type = allowed(type_name, clamp), load_type(type_name)
    checks, one, other = MessageChecks(entry), filled(ros_type, value), filled(ros_type, value)
    assert outcome(lambda: checks.check_finite(one)) == outcome(lambda: check_finite(entry, other))
    assert outcome(lambda: checks.apply_bounds(one)) == outcome(lambda: apply_bounds(entry, other))
    assert repr(one) == repr(other)


def test_a_message_of_another_type_is_refused() -> None:
    checks = MessageChecks(allowed("std_msgs/msg/Int32", False))
    checks.check_type(filled(load_type("std_msgs/msg/Int32"), {}))
    with pytest.raises(RefusedError, match="which takes std_msgs/msg/Int32"):
        checks.check_type(filled(load_type("std_msgs/msg/Float64"), {}))


@pytest.mark.parametrize("type_name", ["geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"])
def test_no_field_is_looked_at_where_all_fits(
    monkeypatch: pytest.MonkeyPatch, type_name: str
) -> None:
    checks, message = MessageChecks(allowed(type_name, False)), filled(load_type(type_name), {})
    looked: list[str] = []
    monkeypatch.setattr(limits, "find_nonfinite", lambda *_: looked.append("finite") or "")
    monkeypatch.setattr(limits, "find_outside", lambda *_: looked.append("bounds") or iter(()))
    monkeypatch.setattr(limits, "type_name_of", lambda _: looked.append("type"))
    checks.check_type(message)
    checks.check_finite(message)
    assert checks.apply_bounds(message) == ()
    assert looked == []


@pytest.mark.parametrize(
    ("type_name", "has"),
    [
        ("geometry_msgs/msg/TwistStamped", False),
        ("std_msgs/msg/String", False),
        ("nav_msgs/msg/Odometry", True),
        ("std_msgs/msg/Float64MultiArray", True),
        ("geometry_msgs/msg/PoseArray", True),
    ],
)
def test_arrays_are_found_at_every_depth(type_name: str, has: bool) -> None:
    assert has_arrays(load_type(type_name)) is has
