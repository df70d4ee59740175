"""The gate knows of a ROS type what its rosidl class tells: fields at every depth, and which values they can hold."""

from __future__ import annotations

import sys

import pytest

from rn_direct_path.fields import filled, load_type, walk_fields
from roboneuron.errors import ConfigurationError, InvalidInputError


def test_fields_are_found_at_every_depth_and_in_arrays() -> None:
    found = dict(walk_fields(load_type("trajectory_msgs/msg/JointTrajectory")))
    assert found["header.stamp.nanosec"] == "uint32"
    assert found["joint_names"] == "string"
    assert found["points"] == "trajectory_msgs/JointTrajectoryPoint"
    assert found["points.positions"] == "double"
    assert found["points.time_from_start.sec"] == "int32"
    assert dict(walk_fields(load_type("geometry_msgs/msg/PoseWithCovariance")))["covariance"] == "double"


@pytest.mark.parametrize("name", ["Twist", "geometry_msgs/Twist", "os/msg/Path", "geometry_msgs/msg/Twits", "../msg/A"])
def test_what_is_no_installed_interface_in_full_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError):
        load_type(name)


def test_a_package_that_holds_no_interfaces_is_not_imported() -> None:
    assert "antigravity" not in sys.modules
    with pytest.raises(ConfigurationError, match="No installed interface"):
        load_type("antigravity/msg/Fly")
    assert "antigravity" not in sys.modules


def test_a_message_holds_the_values_of_an_object_in_the_types_of_its_fields() -> None:
    twist = filled(load_type("geometry_msgs/msg/TwistStamped"), {"twist": {"linear": {"x": 1}}})
    assert isinstance(twist.twist.linear.x, float)  # an integer in a float field would be sent as garbage
    assert (twist.twist.linear.x, twist.twist.linear.y) == (1.0, 0.0)
    point = {"positions": [0, 1.5], "time_from_start": {"sec": 2}}
    trajectory = filled(load_type("trajectory_msgs/msg/JointTrajectory"), {"joint_names": ["a"], "points": [point]})
    assert trajectory.points[0].positions.tolist() == [0.0, 1.5]
    assert trajectory.points[0].time_from_start.sec == 2


@pytest.mark.parametrize(
    ("type_name", "values"),
    [
        ("geometry_msgs/msg/Twist", {"lineal": {}}),
        ("geometry_msgs/msg/Twist", {"linear": 1}),
        ("geometry_msgs/msg/Twist", {"linear": {"x": "fast"}}),
        ("geometry_msgs/msg/Twist", {"linear": {"x": True}}),
        ("std_msgs/msg/Bool", {"data": 1}),
        ("std_msgs/msg/Int8", {"data": 300}),
        ("std_msgs/msg/Int8", {"data": 1.5}),
        ("std_msgs/msg/Float32", {"data": 1e39}),
        ("geometry_msgs/msg/PoseWithCovariance", {"covariance": [1.0]}),
        ("std_msgs/msg/Float64MultiArray", {"data": 1}),
        ("std_msgs/msg/String", {"data": 1}),
    ],
)
def test_a_value_that_a_field_cannot_hold_is_refused(type_name: str, values: object) -> None:
    with pytest.raises(InvalidInputError):
        filled(load_type(type_name), values)
