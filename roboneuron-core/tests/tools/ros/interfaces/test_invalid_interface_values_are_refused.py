"""What does not fit is refused with the path, what came, and what is allowed; nothing large is
echoed.
"""

from __future__ import annotations

import contextlib
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.tools.ros.interfaces import InputLimits, list_interfaces, load_message

INTEGER_TYPES = {
    f"{sign}int{bits}": (0 if sign else -(2 ** (bits - 1)), 2 ** (bits if sign else bits - 1) - 1)
    for sign in ("", "u")
    for bits in (8, 16, 32, 64)
}


def refuse(name: str, value: Any, path: str = "", **kwargs: Any) -> str:
    with pytest.raises(InvalidInputError) as caught:
        load_message(name).encode(value, now_ns=0, **kwargs)
    assert caught.value.path == path
    text = str(caught.value)
    assert "got" in text
    assert "allowed is" in text
    assert len(text) < 1500
    return text


def field_of(ros: str) -> str:
    return f"{ros}_value"


@settings(deadline=None, max_examples=150)
@given(
    ros=st.sampled_from(sorted(INTEGER_TYPES)), offset=st.integers(1, 10**30), below=st.booleans()
)
def test_integers_out_of_range(ros: str, offset: int, below: bool) -> None:
    low, high = INTEGER_TYPES[ros]
    wrong = low - offset if below else high + offset
    text = refuse("test_msgs/msg/BasicTypes", {field_of(ros): wrong}, field_of(ros))
    assert str(high) in text
    refuse("test_msgs/msg/BoundedSequences", {f"{ros}_values": [0, wrong]}, f"{ros}_values[1]")
    refuse("test_msgs/msg/Arrays", {f"{ros}_values": [0, 0, wrong]}, f"{ros}_values[2]")


WRONG = {
    "bool": [0, 1, "true", 1.0, None, [], {}],
    "byte": [True, "1", -1, 256, 1.5, None, b"x", [1]],
    "char": [True, "a", -1, 256, 0.5, None],
    "int32": [True, "1", 1.5, math.nan, math.inf, None, [1], {}],
    "float32": [True, "1.0", None, math.nan, math.inf, -math.inf, 1e308, 3.5e38, 10**40, [0.5], {}],
    "float64": [False, "1.0", None, math.nan, math.inf, -math.inf, 10**400, [], {}],
}


@pytest.mark.parametrize(
    ("ros", "wrong"), [(ros, wrong) for ros, all_wrong in WRONG.items() for wrong in all_wrong]
)
def test_wrong_types_and_numbers(ros: str, wrong: Any) -> None:
    refuse("test_msgs/msg/BasicTypes", {f"{ros}_value": wrong}, f"{ros}_value")
    if not (ros in ("byte", "char") and isinstance(wrong, list)):
        refuse("test_msgs/msg/UnboundedSequences", {f"{ros}_values": [wrong]}, f"{ros}_values[0]")


@pytest.mark.parametrize("wrong", [None, 5, 2.5, True, [], {}, b"bytes"])
def test_text_fields_take_text_only(wrong: Any) -> None:
    refuse("std_msgs/msg/String", {"data": wrong}, "data")
    refuse("test_msgs/msg/WStrings", {"wstring_value": wrong}, "wstring_value")


@pytest.mark.parametrize("wrong", ["a\0b", "\ud800", "x" * 300_000, "é" * 200_000])
def test_text_that_ros_would_damage(wrong: str) -> None:
    refuse("std_msgs/msg/String", {"data": wrong}, "data")


def test_bounded_text_counts_bytes() -> None:
    load_message("test_msgs/msg/Strings").encode({"bounded_string_value": "x" * 22}, now_ns=0)
    for wrong in ("x" * 23, "é" * 12):
        refuse("test_msgs/msg/Strings", {"bounded_string_value": wrong}, "bounded_string_value")


@pytest.mark.parametrize("length", [0, 1, 35, 37, 1000])
def test_fixed_arrays_of_the_wrong_length(length: int) -> None:
    refuse("geometry_msgs/msg/PoseWithCovariance", {"covariance": [0.0] * length}, "covariance")


def test_bounded_arrays_that_are_too_long() -> None:
    refuse("test_msgs/msg/BoundedSequences", {"basic_types_values": [{}] * 4}, "basic_types_values")
    refuse("test_msgs/msg/BoundedSequences", {"uint8_values": "AAAAAAA="}, "uint8_values")


@pytest.mark.parametrize("wrong", ["no base64!", "AAA", "Infinity", "ハロ", "A" * 30_000_000])
def test_bytes_that_are_not_base64(wrong: str) -> None:
    refuse("sensor_msgs/msg/Image", {"data": wrong}, "data")


def test_unknown_fields_name_the_nearest() -> None:
    text = refuse("geometry_msgs/msg/Twist", {"linear": {"X": 1.0}}, "linear")
    assert "'X'" in text
    assert "did you mean 'angular'" in refuse("geometry_msgs/msg/Twist", {"angulr": {}})
    assert "no field at all" in refuse("std_msgs/msg/Empty", {"data": 1})
    refuse("geometry_msgs/msg/Twist", {1: {}})
    refuse("geometry_msgs/msg/Twist", {"l" * 1_000_000: {}})


@pytest.mark.parametrize(
    "hidden", ["_linear", "__class__", "SLOT_TYPES", "_check_fields", "get_fields_and_field_types"]
)
def test_attributes_of_the_message_class_are_not_fields(hidden: str) -> None:
    refuse("geometry_msgs/msg/Twist", {hidden: 1})


@pytest.mark.parametrize("wrong", [None, [], "text", 5, True, [{}]])
def test_anything_but_an_object_for_a_message(wrong: Any) -> None:
    refuse("geometry_msgs/msg/Twist", wrong)
    refuse("geometry_msgs/msg/Twist", {"linear": wrong}, "linear")


def test_a_wrapper_needs_its_only_field() -> None:
    assert "required" in refuse("std_msgs/msg/Float64", {}, "data")
    load_message("std_msgs/msg/Empty").encode({}, now_ns=0)


@pytest.mark.parametrize(
    "wrong", ["now", True, math.nan, math.inf, 2**31, -(2**31) - 1, 1e300, None, [1, 2]]
)
def test_times_that_cannot_be(wrong: Any) -> None:
    refuse("std_msgs/msg/Header", {"stamp": wrong}, "stamp")
    refuse("std_msgs/msg/Header", {"stamp": {"sec": 0, "nanosec": 1_000_000_000}}, "stamp.nanosec")


def test_constants_by_wrong_name_list_the_right_ones() -> None:
    text = refuse("sensor_msgs/msg/NavSatStatus", {"service": "GPS"}, "service")
    assert "SERVICE_GPS=1" in text
    refuse("geometry_msgs/msg/Point", {"x": "ADD"}, "x")


def test_the_path_holds_indices() -> None:
    value = {"points": [{}, {"positions": [0.0, 1, "x"]}]}
    refuse("trajectory_msgs/msg/JointTrajectory", value, "points[1].positions[2]")


def test_deep_and_large_values() -> None:
    deep: Any = 1.0
    for _ in range(100_000):
        deep = [deep]
    refuse("std_msgs/msg/Float64MultiArray", {"data": deep}, "data[0]")
    for _ in range(100_000):
        deep = {"linear": deep}
    refuse("geometry_msgs/msg/Twist", {"linear": deep}, "linear")
    refuse(
        "std_msgs/msg/Float64MultiArray", {"data": [0.0] * 11}, "data", limits=InputLimits(items=10)
    )
    refuse("nav_msgs/msg/Path", {"poses": [{}] * 300_000}, "poses")


def test_a_path_that_is_no_float_cannot_be_nonfinite() -> None:
    with pytest.raises(ConfigurationError, match="voltage"):
        load_message("sensor_msgs/msg/BatteryState", nonfinite=frozenset({"serial_number"}))


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=8,
)


@pytest.mark.parametrize("examples", [60, pytest.param(400, marks=pytest.mark.exhaustive)])
def test_junk_never_raises_anything_else(examples: int) -> None:
    @settings(deadline=None, max_examples=examples)
    @given(
        name=st.sampled_from([str(n) for n in list_interfaces() if n.kind == "msg"]),
        junk=JUNK,
        data=st.data(),
    )
    def check(name: str, junk: Any, data: st.DataObject) -> None:
        part = load_message(name)
        field = data.draw(st.sampled_from([f.name for f in part.fields] or ["data"]))
        with contextlib.suppress(InvalidInputError):
            part.encode({field: junk}, now_ns=0)

    check()
