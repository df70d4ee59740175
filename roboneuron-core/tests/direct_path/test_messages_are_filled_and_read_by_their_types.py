"""The gate knows of a ROS type what its rosidl class tells: fields at every depth, and which values
they can hold.
"""

from __future__ import annotations

import sys

import pytest

from roboneuron.direct_path.fields import check_path, filled, load_type, read_value, walk_fields
from roboneuron.errors import ConfigurationError, InvalidInputError


def test_fields_are_found_at_every_depth_and_in_arrays() -> None:
    found = dict(walk_fields(load_type("trajectory_msgs/msg/JointTrajectory")))
    assert found["header.stamp.nanosec"] == "uint32"
    assert found["joint_names"] == "string"
    assert found["points"] == "trajectory_msgs/JointTrajectoryPoint"
    assert found["points.positions"] == "double"
    assert found["points.time_from_start.sec"] == "int32"
    assert (
        dict(walk_fields(load_type("geometry_msgs/msg/PoseWithCovariance")))["covariance"]
        == "double"
    )


@pytest.mark.parametrize(
    "name", ["Twist", "geometry_msgs/Twist", "os/msg/Path", "geometry_msgs/msg/Twits", "../msg/A"]
)
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
    # an integer in a float field would be sent as garbage
    assert isinstance(twist.twist.linear.x, float)
    assert (twist.twist.linear.x, twist.twist.linear.y) == (1.0, 0.0)
    point = {"positions": [0, 1.5], "time_from_start": {"sec": 2}}
    trajectory = filled(
        load_type("trajectory_msgs/msg/JointTrajectory"), {"joint_names": ["a"], "points": [point]}
    )
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


@pytest.mark.parametrize(
    ("type_name", "path", "expected"),
    [
        ("geometry_msgs/msg/PoseWithCovariance", "covariance[35]", 0.0),
        ("geometry_msgs/msg/PoseWithCovariance", "pose.orientation.w", 1.0),
        ("nav_msgs/msg/Odometry", "pose.covariance[0]", 0.0),
        ("std_msgs/msg/String", "data", ""),
        ("std_msgs/msg/Bool", "data", False),
    ],
)
def test_a_path_reads_one_value(type_name: str, path: str, expected: object) -> None:
    ros_type = load_type(type_name)
    check_path(ros_type, path)
    assert read_value(ros_type(), path) == expected


@pytest.mark.parametrize(
    ("type_name", "path", "text"),
    [
        ("std_msgs/msg/Float64", "__class__.__init__.__globals__", "has no field"),
        ("std_msgs/msg/Float64", "_data", "has no field"),
        ("std_msgs/msg/Float64", "data.real", "it has no fields"),
        ("std_msgs/msg/Float64", "data[0]", "no array"),
        ("std_msgs/msg/Float64", "", "has no field"),
        ("std_msgs/msg/Float64MultiArray", "data.tolist", "an array"),
        ("std_msgs/msg/Float64MultiArray", "data[-1]", "has no field"),
        ("std_msgs/msg/Float64MultiArray", "data[0][1]", "has no field"),
        ("geometry_msgs/msg/Pose", "position", "name one of its fields"),
        ("geometry_msgs/msg/Pose", "position..x", "name one of its fields|has no field"),
    ],
)
def test_a_path_to_anything_but_one_value_is_refused_with_what_there_is(
    type_name: str, path: str, text: str
) -> None:
    ros_type = load_type(type_name)
    with pytest.raises(InvalidInputError, match=text):
        check_path(ros_type, path)
    with pytest.raises(LookupError):
        read_value(ros_type(), path)


def test_an_element_that_is_not_there_now_is_no_value() -> None:
    ros_type = load_type("std_msgs/msg/Float64MultiArray")
    check_path(ros_type, "data[3]")
    with pytest.raises(LookupError, match="now"):
        read_value(ros_type(), "data[3]")
