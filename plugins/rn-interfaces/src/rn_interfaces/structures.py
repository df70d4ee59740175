"""C structures of rosidl (Jazzy) in a type support, and a check of their layout in the installed
wheels.

Sources: rosidl_runtime_c/message_type_support_struct.h, service_type_support_struct.h,
action_type_support_struct.h and type_description/*__struct.h; rosidl_typesupport_fastrtps_cpp/
message_type_support.h and service_type_support.h; rosidl_typesupport_introspection_c/
message_introspection.h and field_types.h.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from pathlib import Path

FASTRTPS = b"rosidl_typesupport_fastrtps_c"
INTROSPECTION = b"rosidl_typesupport_introspection_c"


class Text(ctypes.Structure):
    """rosidl_runtime_c__String."""

    _fields_ = (
        ("data", ctypes.c_char_p),
        ("size", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
    )


def text(value: str) -> Text:
    """Create a structure whose characters live as long as it does."""
    data = value.encode()
    return Text(data, len(data), len(data) + 1)


class FieldType(ctypes.Structure):
    """type_description_interfaces/msg/FieldType."""

    _fields_ = (
        ("type_id", ctypes.c_uint8),
        ("capacity", ctypes.c_uint64),
        ("string_capacity", ctypes.c_uint64),
        ("nested_type_name", Text),
    )


class Field(ctypes.Structure):
    """type_description_interfaces/msg/Field."""

    _fields_ = (("name", Text), ("type", FieldType), ("default_value", Text))


class Fields(ctypes.Structure):
    """Sequence of Field."""

    _fields_ = (
        ("data", ctypes.POINTER(Field)),
        ("size", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
    )


class IndividualDescription(ctypes.Structure):
    """type_description_interfaces/msg/IndividualTypeDescription."""

    _fields_ = (("type_name", Text), ("fields", Fields))


class IndividualDescriptions(ctypes.Structure):
    """Sequence of IndividualDescription."""

    _fields_ = (
        ("data", ctypes.POINTER(IndividualDescription)),
        ("size", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
    )


class Description(ctypes.Structure):
    """type_description_interfaces/msg/TypeDescription."""

    _fields_ = (
        ("type_description", IndividualDescription),
        ("referenced", IndividualDescriptions),
    )


class SourceText(ctypes.Structure):
    """type_description_interfaces/msg/TypeSource."""

    _fields_ = (("type_name", Text), ("encoding", Text), ("raw_file_contents", Text))


class SourceTexts(ctypes.Structure):
    """Sequence of SourceText."""

    _fields_ = (
        ("data", ctypes.POINTER(SourceText)),
        ("size", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
    )


class TypeHash(ctypes.Structure):
    """rosidl_type_hash_t."""

    _fields_ = (("version", ctypes.c_uint8), ("value", ctypes.c_uint8 * 32))


class MessageSupport(ctypes.Structure):
    """rosidl_message_type_support_t."""

    _fields_ = (
        ("identifier", ctypes.c_void_p),
        ("data", ctypes.c_void_p),
        ("handle", ctypes.c_void_p),
        ("type_hash", ctypes.c_void_p),
        ("description", ctypes.c_void_p),
        ("sources", ctypes.c_void_p),
    )


class MessageCallbacks(ctypes.Structure):
    """message_type_support_callbacks_t of rosidl_typesupport_fastrtps_cpp."""

    _fields_ = (
        ("namespace", ctypes.c_char_p),
        ("name", ctypes.c_char_p),
        ("serialize", ctypes.c_void_p),
        ("deserialize", ctypes.c_void_p),
        ("size", ctypes.c_void_p),
        ("max_size", ctypes.c_void_p),
        ("key", ctypes.c_void_p),
    )


class ServiceSupport(ctypes.Structure):
    """rosidl_service_type_support_t."""

    _fields_ = (
        ("identifier", ctypes.c_void_p),
        ("data", ctypes.c_void_p),
        ("handle", ctypes.c_void_p),
        ("request", ctypes.c_void_p),
        ("response", ctypes.c_void_p),
        ("event", ctypes.c_void_p),
        ("event_create", ctypes.c_void_p),
        ("event_destroy", ctypes.c_void_p),
        ("type_hash", ctypes.c_void_p),
        ("description", ctypes.c_void_p),
        ("sources", ctypes.c_void_p),
    )


class ServiceCallbacks(ctypes.Structure):
    """service_type_support_callbacks_t of rosidl_typesupport_fastrtps_cpp."""

    _fields_ = (
        ("namespace", ctypes.c_char_p),
        ("name", ctypes.c_char_p),
        ("request", ctypes.c_void_p),
        ("response", ctypes.c_void_p),
    )


class ActionSupport(ctypes.Structure):
    """rosidl_action_type_support_t."""

    _fields_ = (
        ("goal_service", ctypes.c_void_p),
        ("result_service", ctypes.c_void_p),
        ("cancel_service", ctypes.c_void_p),
        ("feedback_message", ctypes.c_void_p),
        ("status_message", ctypes.c_void_p),
        ("type_hash", ctypes.c_void_p),
        ("description", ctypes.c_void_p),
        ("sources", ctypes.c_void_p),
    )


class Member(ctypes.Structure):
    """rosidl_typesupport_introspection_c__MessageMember."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("type_id", ctypes.c_uint8),
        ("string_upper_bound", ctypes.c_size_t),
        ("members", ctypes.c_void_p),
        ("is_key", ctypes.c_bool),
        ("is_array", ctypes.c_bool),
        ("array_size", ctypes.c_size_t),
        ("is_upper_bound", ctypes.c_bool),
        ("offset", ctypes.c_uint32),
        ("default_value", ctypes.c_void_p),
        ("functions", ctypes.c_void_p * 6),
    )


class Members(ctypes.Structure):
    """rosidl_typesupport_introspection_c__MessageMembers."""

    _fields_ = (
        ("namespace", ctypes.c_char_p),
        ("name", ctypes.c_char_p),
        ("count", ctypes.c_uint32),
        ("size", ctypes.c_size_t),
        ("has_any_key", ctypes.c_bool),
        ("members", ctypes.POINTER(Member)),
        ("init", ctypes.c_void_p),
        ("fini", ctypes.c_void_p),
    )


MEMBER_TYPES = {
    "float": 1,
    "double": 2,
    "char": 4,
    "boolean": 6,
    "octet": 7,
    "uint8": 8,
    "int8": 9,
    "uint16": 10,
    "int16": 11,
    "uint32": 12,
    "int32": 13,
    "uint64": 14,
    "int64": 15,
}
STRING, WSTRING, MESSAGE = 16, 17, 18
"""Kinds of members of rosidl_typesupport_introspection_c."""

GET_HANDLE = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
GET = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)


class LayoutError(RuntimeError):
    """The installed wheels have another layout than these structures."""


@cache
def library(name: str) -> ctypes.CDLL:
    """Load a library of the ROS installation in use, whose symbols are then available to others."""
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    places = [Path(prefix, "lib", name) for prefix in prefixes if prefix]
    place = next((place for place in places if place.exists()), places[-1])
    return ctypes.CDLL(str(place), mode=ctypes.RTLD_GLOBAL)


def pointer_of(capsule: object) -> int:
    """Return the pointer in a nameless PyCapsule."""
    get = ctypes.pythonapi.PyCapsule_GetPointer
    get.restype = ctypes.c_void_p
    get.argtypes = (ctypes.py_object, ctypes.c_char_p)
    return int(get(capsule, None))


def capsule_of(pointer: int) -> object:
    """Return a nameless PyCapsule of a pointer."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype = ctypes.py_object
    new.argtypes = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
    found: object = new(pointer, None, None)
    return found


@cache
def check_layout() -> None:
    """Read the compiled type support of std_msgs/String through the structures.

    Raises
    ------
    LayoutError
        Something in it is not where it should be: these wheels are of another release.
    """
    from std_msgs.msg import String

    metaclass = type(String)
    if metaclass._TYPE_SUPPORT is None:
        metaclass.__import_type_support__()
    support = MessageSupport.from_address(pointer_of(metaclass._TYPE_SUPPORT))
    found = _described(support)
    expected = {
        "name": (b"std_msgs::msg", b"String"),
        "members": (b"std_msgs__msg", b"String", 1, b"data", STRING, False),
        "hash": (1, "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        "description": (b"std_msgs/msg/String", 1, b"data", 17),
    }
    wrong = [name for name, value in expected.items() if found[name] != value]
    if wrong:
        raise LayoutError(
            "ROS types cannot be made at run time with these ROS wheels: the compiled "
            f"std_msgs/String has another {' and '.join(wrong)} than Jazzy's. Compile the types "
            "instead (rn_driver_ros2control.interfaces), or install the ros-jazzy wheels."
        )


def _described(support: MessageSupport) -> dict[str, tuple[object, ...]]:
    address = ctypes.addressof(support)
    handle = GET_HANDLE(support.handle)
    callbacks = MessageCallbacks.from_address(_data(handle(address, FASTRTPS)))
    members = Members.from_address(_data(handle(address, INTROSPECTION)))
    member = members.members[0]
    type_hash = TypeHash.from_address(GET(support.type_hash)(address))
    description = Description.from_address(GET(support.description)(address)).type_description
    field = description.fields.data[0]
    return {
        "name": (callbacks.namespace, callbacks.name),
        "members": (
            members.namespace,
            members.name,
            members.count,
            member.name,
            member.type_id,
            member.is_array,
        ),
        "hash": (type_hash.version, bytes(type_hash.value).hex()),
        "description": (
            description.type_name.data,
            description.fields.size,
            field.name.data,
            field.type.type_id,
        ),
    }


def _data(address: int | None) -> int:
    if not address:
        raise LayoutError("std_msgs/String has no type support of rmw_fastrtps")
    data = MessageSupport.from_address(address).data
    assert data is not None
    return int(data)
