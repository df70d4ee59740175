"""Type supports of rclpy made at run time: what the compiled module
`<package>_s__rosidl_typesupport_c` of a package holds.

The Python classes are those that rosidl_generator_py writes. rclpy turns a message into a ROS
message and back by functions that are Python here, between its calls of the middleware; the ROS
message is a block that holds CDR. What the middleware calls is C (`rn_interfaces.native`).
Everything that C keeps a pointer to lives as long as the process.
"""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import TypeVar

import numpy as np
from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractNestedType,
    AbstractWString,
    Array,
    BasicType,
    BoundedSequence,
)
from rosidl_pycommon import (  # type: ignore[import-untyped]
    convert_camel_case_to_lower_case_underscore as lowered,
)

from rn_interfaces import native
from rn_interfaces import structures as c
from rn_interfaces.cdr_fields import CdrError, type_of
from rn_interfaces.cdr_writing import LARGE
from rn_interfaces.codec import codec
from rn_interfaces.description import TypeDescription
from rn_interfaces.kept import address_of, keep
from rn_interfaces.program import program

logger = logging.getLogger(__name__)
Support = TypeVar("Support", c.MessageSupport, c.ServiceSupport, c.ActionSupport)
Handle = TypeVar("Handle", c.MessageSupport, c.ServiceSupport)
_POINTER = ctypes.sizeof(ctypes.c_void_p)

CREATE = ctypes.CFUNCTYPE(ctypes.c_void_p)
DESTROY = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
FROM_PYTHON = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.py_object, ctypes.c_void_p)
TO_PYTHON = ctypes.CFUNCTYPE(ctypes.py_object, ctypes.c_void_p)


def capsule_of_function(prototype: type, body: Callable[..., object]) -> object:
    """Capsule of a function for rclpy, which then lives as long as the process."""
    pointer = ctypes.cast(keep(prototype(body)), ctypes.c_void_p).value
    assert pointer is not None
    return c.capsule_of(pointer)


def support_of(
    cls: type[Handle],
    name: bytes,
    data: ctypes.Structure,
    description: TypeDescription | None = None,
    others: dict[bytes, int] | None = None,
) -> Handle:
    """Make a type support whose functions are C.

    Args:
        cls: its structure.
        name: by which it is asked for.
        data: what that name says it has.
        description: of the type; its functions are missing when None.
        others: addresses of type supports that it is asked for too, by name.
    """
    support = placed(cls)
    handles = {name: ctypes.addressof(support), **(others or {})}
    describe(support, description, handles)
    support.identifier = identifier(name)
    support.data = address_of(data)
    support.handle = native.entries()["get_handle"]
    return support


def placed(cls: type[Support]) -> Support:
    """Make a structure with the place of its facts right before it."""
    memory = keep((ctypes.c_char * (_POINTER + ctypes.sizeof(cls)))())
    return keep(cls.from_buffer(memory, _POINTER))


def describe(
    support: ctypes.Structure, description: TypeDescription | None, handles: dict[bytes, int]
) -> None:
    """Let a structure of `placed` tell its description and its handles."""
    found = description.addresses if description else (None, None, None)
    facts = native.Facts(
        (ctypes.c_char_p * 2)(*handles),
        (ctypes.c_void_p * 2)(*handles.values()),
        *found,
        address_of(native.functions()),
    )
    place = ctypes.addressof(support) - _POINTER
    ctypes.c_void_p.from_address(place).value = address_of(facts)
    if description is not None:
        called = native.entries()
        support.type_hash = called["get_hash"]
        support.description = called["get_description"]
        support.sources = called["get_sources"]


class MessageTypeSupport:
    """Type support of one message class."""

    def __init__(self, cls: type, description: TypeDescription, namespace: Sequence[str]) -> None:
        """`namespace` is that of the C++ type, such as `("weld_msgs", "msg")`."""
        self._cls = cls
        self._codec = codec(cls)
        self._program = ctypes.addressof(program(cls))
        self._functions = address_of(native.functions())
        self._release = native.release()
        self._blocks: dict[int, native.Block] = {}
        self._spare: list[int] = []  # addresses of blocks that were destroyed
        called = native.entries()
        callbacks = c.MessageCallbacks(
            "::".join(namespace).encode(),
            cls.__name__.encode(),
            *(called[name] for name in ("serialize", "deserialize", "size", "max_size")),
            None,
        )
        introspection = {c.INTROSPECTION: introspection_of(cls, tuple(namespace))}
        self.support = support_of(
            c.MessageSupport, c.FASTRTPS, callbacks, description, introspection
        )
        self.create = capsule_of_function(CREATE, self._create)
        self.destroy = capsule_of_function(DESTROY, self._destroy)
        self.from_python = capsule_of_function(FROM_PYTHON, self._from_python)
        self.to_python = capsule_of_function(TO_PYTHON, self._to_python)
        self.address = ctypes.addressof(self.support)
        self.capsule = c.capsule_of(self.address)

    def _create(self) -> int:
        try:
            return self._spare.pop()
        except IndexError:
            block = native.Block(program=self._program, functions=self._functions)
            place = ctypes.addressof(block)
            self._blocks[place] = block
            return place

    def _destroy(self, place: int) -> None:
        block = self._blocks[place]
        if block.taken:
            self._release(block.taken)
            block.taken = None
        block.data = None  # which lets go of the bytes
        if block.views:
            block.views = ()
        self._spare.append(place)

    def _from_python(self, message: object, place: int) -> bool:
        try:
            data = self._codec.encode(message)
        except CdrError as error:
            # rclpy then raises a RuntimeError that does not know the reason
            logger.error("%s", error)
            return False
        block = self._blocks[place]
        if isinstance(data, bytes):
            block.data = data
            block.size = block.total = len(data)
            block.count = 0
        else:
            block.size = 0
            views = [np.frombuffer(part, np.uint8) for part in data]
            parts = (native.Part * len(views))()
            for part, view in zip(parts, views, strict=True):
                part.data, part.size = view.ctypes.data, len(view)
            block.parts = parts
            block.count = len(views)
            block.total = sum(map(len, views))
            block.views = views
        return True

    def _to_python(self, place: int) -> object:
        block = self._blocks[place]
        try:
            if block.taken_size < LARGE:
                return self._codec.decode(ctypes.string_at(block.taken, block.taken_size))
            memory = (ctypes.c_char * block.taken_size).from_address(block.taken)
            return self._codec.decode(memoryview(memory).cast("B"))
        except Exception:  # rclpy has no way to be told
            logger.exception("A %s cannot be decoded; None stands for it.", self._cls.__name__)
            return None


@cache
def identifier(name: bytes) -> int:
    """Address of the text by which a typesupport is asked for, that of its own library."""
    if name == c.INTROSPECTION:
        symbol = "rosidl_typesupport_introspection_c__identifier"
        library = c.library("librosidl_typesupport_introspection_c.so")
        found = ctypes.c_void_p.in_dll(library, symbol).value
    else:
        found = ctypes.cast(keep(ctypes.c_char_p(name)), ctypes.c_void_p).value
    assert found is not None
    return found


@cache
def introspection_of(cls: type, namespace: tuple[str, ...]) -> int:
    """Address of the type support by which rmw_fastrtps describes a type to others."""
    fields = cls.get_fields_and_field_types()  # type: ignore[attr-defined]
    slots = cls.SLOT_TYPES  # type: ignore[attr-defined]
    members = [_member(cls, name, slot) for name, slot in zip(fields, slots, strict=True)]
    if not members:
        members = [_number("structure_needs_at_least_one_member", c.MEMBER_TYPES["uint8"])]
    block = keep((c.Member * len(members))(*members))
    described = c.Members(
        "__".join(namespace).encode(),
        cls.__name__.encode(),
        len(members),
        ctypes.sizeof(native.Block),
        False,
        block,
        None,
        None,
    )
    return ctypes.addressof(support_of(c.MessageSupport, c.INTROSPECTION, described))


def _number(name: str, kind: int) -> c.Member:
    return c.Member(name.encode(), kind)


def _member(owner: type, name: str, slot: object) -> c.Member:
    member = c.Member(name.encode())
    if isinstance(slot, AbstractNestedType):
        member.is_array = True
        if isinstance(slot, Array):
            member.array_size = slot.size
        elif isinstance(slot, BoundedSequence):
            member.array_size = slot.maximum_size
            member.is_upper_bound = True
        slot = slot.value_type
    if isinstance(slot, BasicType):
        member.type_id = c.MEMBER_TYPES[slot.typename]
    elif isinstance(slot, AbstractGenericString):
        member.type_id = c.WSTRING if isinstance(slot, AbstractWString) else c.STRING
        member.string_upper_bound = slot.maximum_size if slot.has_maximum_size() else 0
    else:
        member.type_id = c.MESSAGE
        nested = type_of(owner, slot)
        member.members = introspection_of(nested, tuple(slot.namespaces))  # type: ignore[attr-defined]
    return member


class Supports:
    """What `<package>_s__rosidl_typesupport_c` holds, made when it is asked for."""

    def __init__(self, package: str, describe: Callable[[str], TypeDescription]) -> None:
        """`describe` takes a full name, such as `weld_msgs/msg/Seam`."""
        c.check_layout()
        native.check()
        self._package = package
        self._describe = describe
        self._classes: dict[str, MessageTypeSupport] = {}

    def __call__(self, name: str) -> object:
        """Return the capsule of a name of the compiled module, such as
        `type_support_msg__srv__set_bool__request`.

        Raises
        ------
        AttributeError
            The package has no such interface.
        """
        what, _, path = name.partition("__")
        kind, _, rest = path.partition("__")
        makers = {
            "type_support_msg": lambda one: one.capsule,
            "create_ros_message_msg": lambda one: one.create,
            "destroy_ros_message_msg": lambda one: one.destroy,
            "convert_from_py_msg": lambda one: one.from_python,
            "convert_to_py_msg": lambda one: one.to_python,
        }
        if what in makers:
            return makers[what](self._message(kind, rest))
        if what == "type_support_srv":
            return c.capsule_of(self._service(kind, rest))
        if what == "type_support_action":
            return c.capsule_of(self._action(kind, rest))
        raise AttributeError(name)

    def _class(self, kind: str, lower: str) -> type:
        module = self._module(kind, lower)
        for name, value in vars(module).items():
            if isinstance(value, type) and lowered(name) == lower:
                return value
        raise AttributeError(f"{self._package} has no interface {kind}/{lower}")

    def _module(self, kind: str, lower: str) -> ModuleType:
        stem = lower
        while stem:
            try:
                return import_module(f"{self._package}.{kind}._{stem}")
            except ModuleNotFoundError:
                stem = stem.rpartition("__")[0]
        raise AttributeError(f"{self._package} has no interface {kind}/{lower}")

    def _message(self, kind: str, lower: str) -> MessageTypeSupport:
        key = f"{kind}/{lower}"
        if key not in self._classes:
            cls = self._class(kind, lower)
            description = self._describe(f"{self._package}/{kind}/{cls.__name__}")
            self._classes[key] = MessageTypeSupport(cls, description, (self._package, kind))
        return self._classes[key]

    def _service(self, kind: str, lower: str) -> int:
        cls = self._class(kind, lower)
        request, response, event = (
            self._message(kind, f"{lower}__{part}").address
            for part in ("request", "response", "event")
        )
        namespace = f"{self._package}::{kind}".encode()
        callbacks = c.ServiceCallbacks(namespace, cls.__name__.encode(), request, response)
        description = self._describe(f"{self._package}/{kind}/{cls.__name__}")
        support = support_of(c.ServiceSupport, c.FASTRTPS, callbacks, description)
        support.request, support.response, support.event = request, response, event
        return ctypes.addressof(support)

    def _action(self, kind: str, lower: str) -> int:
        from action_msgs.msg import GoalStatusArray
        from action_msgs.srv import CancelGoal

        cls = self._class(kind, lower)
        support = placed(c.ActionSupport)
        support.goal_service = self._service(kind, f"{lower}__send_goal")
        support.result_service = self._service(kind, f"{lower}__get_result")
        support.cancel_service = compiled(CancelGoal)
        support.feedback_message = self._message(kind, f"{lower}__feedback_message").address
        support.status_message = compiled(GoalStatusArray)
        description = self._describe(f"{self._package}/{kind}/{cls.__name__}")
        describe(support, description, {})
        return ctypes.addressof(support)


def compiled(cls: type) -> int:
    """Address of the type support of a compiled class."""
    metaclass = type(cls)
    if metaclass._TYPE_SUPPORT is None:  # type: ignore[attr-defined]
        metaclass.__import_type_support__()  # type: ignore[attr-defined]
    return c.pointer_of(metaclass._TYPE_SUPPORT)  # type: ignore[attr-defined]
