"""Type supports of rclpy made at run time: what the compiled module
`<package>_s__rosidl_typesupport_c` of a package holds.

The Python classes are those that rosidl_generator_py writes. A ROS message in C is a block of
memory whose address stands for a Python object: its CDR on the way out, the message on the way in.
Everything that C keeps a pointer to lives as long as the process.

rclpy publishes and takes with the GIL held, and Fast DDS calls these functions with the lock of a
reader or writer held. Python may hand the GIL to another thread within such a function; if that one
published or took on the same topic, it would wait for that lock with the GIL in its hands, forever.
So a lock of each type is held from the moment when rclpy makes a ROS message until it destroys it,
and whoever waits for it waits without the GIL. This does not cover all: four threads that publish
one topic at full speed while others take it have been seen to stop.
"""

from __future__ import annotations

import ctypes
import logging
import threading
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

from rn_interfaces import structures as c
from rn_interfaces.codec import CdrError, Parts, codec, type_of
from rn_interfaces.description import TypeDescription

logger = logging.getLogger(__name__)
Kept = TypeVar("Kept")
_kept: list[object] = []
"""What C code has pointers to."""
_held: dict[int, object] = {}
"""By the address of a ROS message: what it stands for."""
PATIENCE_S = 1.0
"""For another thread with a message of the type: publishing and taking last milliseconds."""
BLOCK = 16
"""Size of a ROS message [B]; only its address is used."""

BUFFER_OFFSET = 14 * ctypes.sizeof(ctypes.c_void_p)
"""Of the reference to its FastBuffer in a Cdr [B], after the pointers to its member functions."""

CREATE = ctypes.CFUNCTYPE(ctypes.c_void_p)
DESTROY = ctypes.CFUNCTYPE(None, ctypes.c_void_p)
FROM_PYTHON = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.py_object, ctypes.c_void_p)
TO_PYTHON = ctypes.CFUNCTYPE(ctypes.py_object, ctypes.c_void_p)
SERIALIZE = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_void_p)
SIZE = ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_void_p)
MAX_SIZE = ctypes.CFUNCTYPE(ctypes.c_size_t, ctypes.POINTER(ctypes.c_char))


def keep(value: Kept) -> Kept:
    """Let a value live as long as the process."""
    _kept.append(value)
    return value


def address_of(value: ctypes.Structure) -> int:
    """Address of a structure, which then lives as long as the process."""
    return ctypes.addressof(keep(value))


def address_of_function(prototype: type, body: Callable[..., object]) -> int:
    """Address of a function for C, which then lives as long as the process."""
    pointer = ctypes.cast(keep(prototype(body)), ctypes.c_void_p).value
    assert pointer is not None
    return pointer


class FastCdr:
    """Functions of libfastcdr, by the names of its symbols (Fast CDR 2.2)."""

    def __init__(self) -> None:
        library = c.library("libfastcdr.so.2")
        self.write = library["_ZN8eprosima7fastcdr3Cdr15serialize_arrayEPKcm"]
        self.write.argtypes = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_size_t)
        self.write.restype = ctypes.c_void_p
        # a second object of the same function, for memory that is not of Python's bytes
        self.write_block = library["_ZN8eprosima7fastcdr3Cdr15serialize_arrayEPKcm"]
        self.write_block.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)
        self.write_block.restype = ctypes.c_void_p
        self.begin = library["_ZN8eprosima7fastcdr3Cdr18get_buffer_pointerEv"]
        self.begin.argtypes = (ctypes.c_void_p,)
        self.begin.restype = ctypes.c_void_p
        self.place = library["_ZN8eprosima7fastcdr3Cdr20get_current_positionEv"]
        self.place.argtypes = (ctypes.c_void_p,)
        self.place.restype = ctypes.c_void_p

    def rest(self, cdr: int) -> bytes:
        """Return all bytes that are left.

        No function says how many: the size stands in the buffer that a Cdr refers to.
        """
        buffer = ctypes.c_void_p.from_address(cdr + BUFFER_OFFSET).value
        if not buffer:
            raise CdrError("Fast CDR gives no buffer where 2.2 does")
        _, memory, size = (ctypes.c_size_t * 3).from_address(buffer)
        place = self.place(cdr)
        if memory != self.begin(cdr) or not memory <= place <= memory + size:
            raise CdrError("the buffer of Fast CDR is not laid out as that of 2.2")
        return ctypes.string_at(place, memory + size - place)


@cache
def fast_cdr() -> FastCdr:
    """The library, loaded once.

    Raises
    ------
    LayoutError
        It is of another release.
    """
    try:
        return FastCdr()
    except (OSError, AttributeError) as error:
        raise c.LayoutError(
            f"types cannot be made at run time with this Fast CDR: {error}"
        ) from error


class MessageType:
    """Type support of one message class."""

    def __init__(self, cls: type, description: TypeDescription, namespace: Sequence[str]) -> None:
        """`namespace` is that of the C++ type, such as `("weld_msgs", "msg")`."""
        self._cls = cls
        self._codec = codec(cls)
        self._cdr = fast_cdr()
        self._lock = threading.RLock()
        self._taken: dict[int, threading.RLock] = {}  # by block, what its destruction releases
        self._spare: list[int] = []  # blocks that were destroyed: as many as a thread has at a time
        callbacks = c.MessageCallbacks(
            "::".join(namespace).encode(),
            cls.__name__.encode(),
            address_of_function(SERIALIZE, self._serialize),
            address_of_function(SERIALIZE, self._deserialize),
            address_of_function(SIZE, self._size),
            address_of_function(MAX_SIZE, _no_maximum),
            None,
        )
        self.support = c.MessageSupport()
        introspection = introspection_of(cls, tuple(namespace))
        self.support.identifier = identifier(c.FASTRTPS)
        self.support.data = address_of(callbacks)
        self.support.handle = handles(
            {c.FASTRTPS: address_of(self.support), c.INTROSPECTION: introspection}
        )
        described = description.functions()
        self.support.type_hash, self.support.description, self.support.sources = described
        self.create = c.capsule_of(address_of_function(CREATE, self._create))
        self.destroy = c.capsule_of(address_of_function(DESTROY, self._destroy))
        self.from_python = c.capsule_of(address_of_function(FROM_PYTHON, self._from_python))
        self.to_python = c.capsule_of(address_of_function(TO_PYTHON, _held.__getitem__))
        self.address = ctypes.addressof(self.support)
        self.capsule = c.capsule_of(self.address)

    def _create(self) -> int:
        lock = self._lock
        if not lock.acquire(timeout=PATIENCE_S):
            logger.error("The lock of %s was not released; it is replaced.", self._cls.__name__)
            lock = self._lock = threading.RLock()
            lock.acquire()
        place = self._block()
        self._taken[place] = lock
        return place

    def _block(self) -> int:
        if self._spare:
            return self._spare.pop()
        block = ctypes.create_string_buffer(BLOCK)
        place = ctypes.addressof(block)
        keep(block)
        return place

    def _destroy(self, place: int) -> None:
        _held.pop(place, None)
        lock = self._taken.pop(place)
        self._spare.append(place)
        lock.release()

    def _from_python(self, message: object, place: int) -> bool:
        try:
            _held[place] = self._codec.encode(message)
        except CdrError as error:
            # rclpy then raises a RuntimeError that does not know the reason
            logger.error("%s", error)
            return False
        return True

    def _serialize(self, place: int, cdr: int) -> bool:
        data = _held[place]
        if data.__class__ is bytes:
            self._cdr.write(cdr, data, len(data))
            return True
        assert isinstance(data, Parts)
        for part in data:
            block = np.frombuffer(part, np.uint8)
            self._cdr.write_block(cdr, block.ctypes.data, len(block))
        return True

    def _deserialize(self, cdr: int, place: int) -> bool:
        try:
            _held[place] = self._codec.decode(self._cdr.rest(cdr))
        except CdrError as error:
            logger.warning("A message is dropped: %s", error)
            return False
        return True

    def _size(self, place: int) -> int:
        data = _held[place]
        if data.__class__ is bytes:
            return len(data)
        assert isinstance(data, Parts)
        return len(data) + sum(len(block) for _, block in data.blocks)


def _no_maximum(bounds: ctypes._Pointer[ctypes.c_char]) -> int:
    bounds[0] = b"\0"  # unbounded
    return 0


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


def handles(by_name: dict[bytes, int]) -> int:
    """Address of a function that returns a typesupport by its identifier."""
    return address_of_function(c.GET_HANDLE, lambda _, name: by_name.get(name))


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
        BLOCK,
        False,
        block,
        None,
        None,
    )
    support = c.MessageSupport()
    support.identifier = identifier(c.INTROSPECTION)
    support.data = address_of(described)
    support.handle = handles({c.INTROSPECTION: address_of(support)})
    return ctypes.addressof(support)


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
        self._package = package
        self._describe = describe
        self._classes: dict[str, MessageType] = {}

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

    def _message(self, kind: str, lower: str) -> MessageType:
        key = f"{kind}/{lower}"
        if key not in self._classes:
            cls = self._class(kind, lower)
            description = self._describe(f"{self._package}/{kind}/{cls.__name__}")
            self._classes[key] = MessageType(cls, description, (self._package, kind))
        return self._classes[key]

    def _service(self, kind: str, lower: str) -> int:
        cls = self._class(kind, lower)
        request, response, event = (
            self._message(kind, f"{lower}__{part}").address
            for part in ("request", "response", "event")
        )
        namespace = f"{self._package}::{kind}".encode()
        callbacks = c.ServiceCallbacks(namespace, cls.__name__.encode(), request, response)
        support = c.ServiceSupport()
        support.identifier = identifier(c.FASTRTPS)
        support.data = address_of(callbacks)
        support.handle = handles({c.FASTRTPS: address_of(support)})
        support.request, support.response, support.event = request, response, event
        description = self._describe(f"{self._package}/{kind}/{cls.__name__}")
        support.type_hash, support.description, support.sources = description.functions()
        return ctypes.addressof(support)

    def _action(self, kind: str, lower: str) -> int:
        from action_msgs.msg import GoalStatusArray
        from action_msgs.srv import CancelGoal

        cls = self._class(kind, lower)
        support = c.ActionSupport()
        support.goal_service = self._service(kind, f"{lower}__send_goal")
        support.result_service = self._service(kind, f"{lower}__get_result")
        support.cancel_service = compiled(CancelGoal)
        support.feedback_message = self._message(kind, f"{lower}__feedback_message").address
        support.status_message = compiled(GoalStatusArray)
        description = self._describe(f"{self._package}/{kind}/{cls.__name__}")
        support.type_hash, support.description, support.sources = description.functions()
        return address_of(support)


def compiled(cls: type) -> int:
    """Address of the type support of a compiled class."""
    metaclass = type(cls)
    if metaclass._TYPE_SUPPORT is None:  # type: ignore[attr-defined]
        metaclass.__import_type_support__()  # type: ignore[attr-defined]
    return c.pointer_of(metaclass._TYPE_SUPPORT)  # type: ignore[attr-defined]
