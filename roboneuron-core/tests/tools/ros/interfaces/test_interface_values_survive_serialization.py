"""Random valid values of every installed interface: encoded, serialised, deserialised, decoded,
equal.
"""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from roboneuron.tools.ros.interfaces import LOSSLESS, list_interfaces, load_message

NAMES = [str(name) for name in list_interfaces()]


@pytest.mark.sampled(every=8)
@pytest.mark.parametrize("name", NAMES)
def test_values_are_equal_after_the_wire(name: str, interface_values) -> None:
    @settings(max_examples=12, deadline=None, derandomize=True, database=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def check(seed: int) -> None:
        for part in interface_values.parts_of(name):
            value = interface_values.ValueGenerator(seed).value(part.message)
            sent = part.encode(value, now_ns=1_234_567_890_123_456_789)
            received = deserialize_message(serialize_message(sent), part.ros_type)
            decoded = part.decode(received, LOSSLESS)
            assert interface_values.differences(part.message, value, decoded) == []
            again = part.encode(decoded, now_ns=None)
            assert part.decode(again, LOSSLESS) == decoded

    check()


@settings(deadline=None, max_examples=200)
@given(value=st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(2**70), 2**70))
def test_a_float64_arrives_as_the_nearest_double(value: float) -> None:
    number = load_message("std_msgs/msg/Float64")
    message = number.encode({"data": value}, now_ns=None)
    assert deserialize_message(serialize_message(message), number.ros_type).data == float(value)


@settings(deadline=None, max_examples=200)
@given(
    value=st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=50)
)
def test_text_arrives_unchanged(value: str) -> None:
    for name in ("std_msgs/msg/String", "test_msgs/msg/WStrings"):
        part = load_message(name)
        field = part.fields[0].name
        message = part.encode({field: value}, now_ns=None)
        assert (
            getattr(deserialize_message(serialize_message(message), part.ros_type), field) == value
        )


@settings(deadline=None, max_examples=100)
@given(
    values=st.lists(
        st.floats(width=32, allow_nan=False, allow_infinity=False) | st.integers(-1000, 1000),
        max_size=200,
    )
)
def test_float32_lists_arrive_exactly(values: list[float]) -> None:
    part = load_message("std_msgs/msg/Float32MultiArray")
    message = part.encode({"data": values}, now_ns=None)
    assert list(deserialize_message(serialize_message(message), part.ros_type).data) == values


def test_defaults_are_the_definitions_own() -> None:
    part = load_message("test_msgs/msg/Defaults")
    assert part.encode({}, now_ns=None) == part.ros_type()
    assert part.decode(part.encode({}, now_ns=None))["byte_value"] == 50
    assert load_message("geometry_msgs/msg/Pose").encode({}, now_ns=None).orientation.w == 1.0


def test_not_a_number_passes_only_where_it_is_configured() -> None:
    part = load_message(
        "sensor_msgs/msg/BatteryState", nonfinite=frozenset({"temperature", "cell_voltage"})
    )
    value = {"temperature": "NaN", "cell_voltage": ["Infinity", 1, "-Infinity", float("nan")]}
    received = deserialize_message(
        serialize_message(part.encode(value, now_ns=None)), part.ros_type
    )
    decoded = part.decode(received)
    assert decoded["temperature"] == "NaN"
    assert decoded["cell_voltage"] == ["Infinity", 1.0, "-Infinity", "NaN"]
    assert part.decode(part.encode(part.model.model_validate(value), now_ns=None)) == decoded


def test_an_omitted_stamp_becomes_now_at_every_depth_and_a_given_one_stays() -> None:
    now_ns = 1_700_000_000_123_456_789
    pose = load_message("geometry_msgs/msg/PoseStamped").encode({"pose": {}}, now_ns=now_ns)
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    path = load_message("nav_msgs/msg/Path").encode(
        {"poses": [{}, {"header": {"frame_id": "map"}}]}, now_ns=now_ns
    )
    assert [p.header.stamp.nanosec for p in path.poses] == [123_456_789] * 2
    given = load_message("geometry_msgs/msg/PoseStamped").encode(
        {"header": {"stamp": 2.5}}, now_ns=now_ns
    )
    assert (given.header.stamp.sec, given.header.stamp.nanosec) == (2, 500_000_000)
    assert load_message("std_msgs/msg/Header").encode({}, now_ns=None).stamp.sec == 0


def test_only_headers_are_stamped() -> None:
    goal = load_message("action_msgs/msg/GoalInfo").encode({}, now_ns=5)
    assert goal.stamp.nanosec == 0


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        (0, (0, 0)),
        (-0.5, (-1, 500_000_000)),
        (1.9999999999, (2, 0)),
        (1e-9, (0, 1)),
        (-(2**31), (-(2**31), 0)),
        (3, (3, 0)),
    ],
)
def test_seconds_become_sec_and_nanosec(seconds: float, expected: tuple[int, int]) -> None:
    duration = load_message("builtin_interfaces/msg/Duration").encode({}, now_ns=None)
    point = load_message("trajectory_msgs/msg/JointTrajectoryPoint").encode(
        {"time_from_start": seconds}, now_ns=None
    )
    duration = point.time_from_start
    assert (duration.sec, duration.nanosec) == expected
