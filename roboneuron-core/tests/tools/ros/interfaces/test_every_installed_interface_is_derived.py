"""Names, constants, defaults, comments and collisions of derived interfaces."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter

import pytest
from rosidl_parser import definition as rosidl

from roboneuron.errors import ConfigurationError
from roboneuron.tools.ros.interfaces import (
    Array,
    MessageInterface,
    Scalar,
    ServiceInterface,
    interface_prefixes,
    list_interfaces,
    load_action,
    load_interface,
    load_message,
    load_service,
)
from roboneuron.tools.ros.interfaces.comments import parse_comments
from roboneuron.tools.ros.interfaces.derive import Deriver

pytest.importorskip("test_msgs", reason="pip install ros-jazzy-test-msgs")


def test_all_interfaces_of_the_wheels_are_derived(interface_values) -> None:
    names = list_interfaces()
    kinds = Counter(name.kind for name in names)
    assert kinds["msg"] >= 169
    assert kinds["srv"] >= 28
    assert kinds["action"] >= 2
    for name in names:
        for part in interface_values.parts_of(name):
            assert [f.name for f in part.fields] == list(part.ros_type.get_fields_and_field_types())


def test_a_name_without_kind_finds_the_message_first() -> None:
    assert load_interface("sensor_msgs/Image").name == "sensor_msgs/msg/Image"
    assert load_interface("std_srvs/SetBool").kind == "srv"
    assert load_interface("test_msgs/Empty").kind == "msg"


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("geometry_msgs/msg/Twits", "geometry_msgs/msg/Twist"),
        ("geometry_msg/Twist", "geometry_msgs/msg/Twist"),
        ("other_msgs/msg/Image", "sensor_msgs/msg/Image"),
    ],
)
def test_an_unknown_name_is_answered_with_the_nearest(name: str, nearest: str) -> None:
    with pytest.raises(ConfigurationError, match=nearest):
        load_interface(name)


@pytest.mark.parametrize(
    "name",
    [
        "",
        "x",
        "a/b/c/d",
        "../msg/X",
        "os/msg/path",
        "std_msgs/msg/__init__",
        "std_msgs/msg/string",
        "std_msgs.msg/X",
        "std_msgs/msg/String\n",
        "/std_msgs/String",
        "std_msgs//String",
    ],
)
def test_what_is_not_written_like_a_name_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError):
        load_interface(name)


def test_looking_up_a_name_imports_no_package_that_holds_no_interfaces() -> None:
    with pytest.raises(ConfigurationError):
        load_interface("antigravity/msg/Anything")
    assert "antigravity" not in sys.modules


def test_the_wrong_kind_is_refused() -> None:
    for load in (load_service, load_action):
        with pytest.raises(ConfigurationError, match="std_msgs/msg/String is not"):
            load("std_msgs/msg/String")
    with pytest.raises(ConfigurationError, match="std_srvs/srv/Empty is not a message"):
        load_message("std_srvs/srv/Empty")


def test_prefixes_fall_back_to_the_interpreter(tmp_path) -> None:
    assert [str(p) for p in interface_prefixes({})] == [sys.prefix]
    both = interface_prefixes({"AMENT_PREFIX_PATH": f"{tmp_path}{os.pathsep}/nowhere"})
    assert [str(p) for p in both] == [str(tmp_path), sys.prefix]


def test_listing_is_restricted_to_a_package() -> None:
    assert {n.package for n in list_interfaces("std_srvs")} == {"std_srvs"}
    assert list_interfaces("nothing_msgs") == ()


def test_importing_the_package_loads_no_ros_and_changes_no_environment() -> None:
    code = (
        "import os, sys; before = dict(os.environ); import roboneuron.tools.ros.interfaces; "
        "assert dict(os.environ) == before; "
        "assert not [m for m in sys.modules if m.split('.')[0] in ('rclpy', 'std_msgs', 'PIL')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_bounds_sizes_and_defaults_come_from_the_types() -> None:
    basic = {f.name: f for f in load_message("test_msgs/msg/Defaults").fields}
    assert basic["byte_value"].default == 50
    assert basic["uint64_value"].default == 50000000
    assert basic["uint64_value"].type == Scalar(ros="uint64", lower=0, upper=2**64 - 1)
    text = {f.name: f.type for f in load_message("test_msgs/msg/Strings").fields}
    assert text["bounded_string_value"] == Scalar(ros="string", max_length=22)
    arrays = {f.name: f for f in load_message("test_msgs/msg/BoundedSequences").fields}
    shape = arrays["uint8_values"].type
    assert isinstance(shape, Array)
    assert (shape.size, shape.fixed) == (3, False)
    assert arrays["int64_values_default"].default == [0, 2**63 - 1, -(2**63)]


def _choices(name: str) -> dict[str, list[str]]:
    interface = load_interface(name)
    part = interface.response if isinstance(interface, ServiceInterface) else interface
    assert isinstance(part, MessageInterface)
    return {f.name: [c.name for c in f.choices] for f in part.fields if f.choices}


def test_constants_go_to_the_field_they_clearly_belong_to() -> None:
    battery = _choices("sensor_msgs/msg/BatteryState")
    assert set(battery) == {"power_supply_status", "power_supply_health", "power_supply_technology"}
    assert battery["power_supply_status"][-1] == "POWER_SUPPLY_STATUS_FULL"
    assert set(_choices("sensor_msgs/msg/NavSatStatus")) == {"status", "service"}
    assert list(_choices("rcl_interfaces/msg/Log")) == ["level"]
    assert _choices("visualization_msgs/msg/Marker")["action"] == [
        "ADD",
        "MODIFY",
        "DELETE",
        "DELETEALL",
    ]
    assert _choices("shape_msgs/msg/SolidPrimitive") == {
        "type": ["BOX", "SPHERE", "CYLINDER", "CONE", "PRISM"]
    }
    assert _choices("diagnostic_msgs/msg/DiagnosticStatus") == {
        "level": ["OK", "WARN", "ERROR", "STALE"]
    }
    assert list(_choices("nav_msgs/srv/LoadMap")) == ["result"]


def test_constants_without_a_clear_field_are_only_mentioned() -> None:
    field_type = load_message("type_description_interfaces/msg/FieldType")
    assert not any(f.choices for f in field_type.fields)
    assert "FIELD_TYPE_INT8=2" in field_type.json_schema()["description"]


def test_comments_and_units_become_descriptions() -> None:
    range_message = load_message("sensor_msgs/msg/Range")
    assert range_message.message.text.startswith("Single range reading")
    field = next(f for f in range_message.fields if f.name == "max_range")
    assert field.unit == "m"
    assert range_message.json_schema()["properties"]["max_range"]["description"].endswith("[m]")
    request = load_service("sensor_msgs/srv/SetCameraInfo").request
    assert request.fields[0].text == "The camera_info to store"


def test_comments_survive_odd_idl() -> None:
    idl = r"""
    // a comment with struct X { in it
    module m { module msg {
      @verbatim (language="comment", text=
        "He said \"hi\"" "\n"        "twice; { } @")
      struct S {
        @verbatim (language="comment", text="one")
        @unit (value="m/s") @default (value=1.5)
        double__9 a;
        sequence<double, 3> b;
      };
    }; };
    """
    ((name, struct),) = parse_comments(idl).items()
    assert name == "S"
    assert struct.text == 'He said "hi" twice; { } @'
    assert struct.fields == {"a": "one"}
    assert struct.units == {"a": "m/s"}


def _fake_class(fields: dict[str, str]) -> type:
    """A class shaped like rosidl's generated ones, with names that no generator of today would
    allow.
    """

    def init(self, **kwargs) -> None:
        for name in fields:
            setattr(self, name, 0.0)

    meta = type(
        "Metaclass_Odd",
        (type,),
        {"__prepare__": classmethod(lambda cls, name, bases, **kwargs: {})},
    )
    body = {
        "__module__": "odd_msgs.msg._odd",
        "__init__": init,
        "get_fields_and_field_types": classmethod(lambda cls: dict(fields)),
        "SLOT_TYPES": tuple(rosidl.BasicType(t) for t in fields.values()),
    }
    return meta("Odd", (), body)


def test_names_that_python_or_pydantic_keep_for_themselves_work() -> None:
    names = (
        "data",
        "model_",
        "model_fields",
        "copy",
        "json",
        "schema",
        "from",
        "_hidden",
        "self",
        "class",
        "dict",
        "construct",
    )
    interface = MessageInterface(Deriver().derive(_fake_class(dict.fromkeys(names, "double"))))
    value = {name: float(i) for i, name in enumerate(names)}
    message = interface.encode(value, now_ns=None)
    assert interface.decode(message) == value
    model = interface.model.model_validate(value)
    assert model.model_dump(by_alias=True) == value
    assert interface.decode(interface.encode(model, now_ns=None)) == value
    assert set(interface.json_schema()["properties"]) == set(names)
