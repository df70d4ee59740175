"""C functions of a type support for Fast DDS, and the structures that they use.

Fast DDS calls them while it holds locks, so none of them is Python; see `native.c`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import cache

from rn_interfaces import structures as c
from rn_interfaces.kept import keep
from rn_interfaces.library import LibraryError, find_library

ENTRIES = (
    *("is_valid", "serialize", "deserialize", "size", "max_size"),
    *("get_handle", "get_hash", "get_description", "get_sources"),
)
"""The functions of native.c."""


class Functions(ctypes.Structure):
    """External functions that native.c calls."""

    _fields_ = (
        ("write", ctypes.c_void_p),
        ("begin", ctypes.c_void_p),
        ("place", ctypes.c_void_p),
        ("allocate", ctypes.c_void_p),
        ("release", ctypes.c_void_p),
        ("copy", ctypes.c_void_p),
        ("compare", ctypes.c_void_p),
    )


class Part(ctypes.Structure):
    """A part of CDR."""

    _fields_ = (("data", ctypes.c_void_p), ("size", ctypes.c_size_t))


class Block(ctypes.Structure):
    """A ROS message in rclpy's representation; its address is that of the message."""

    _fields_ = (
        ("data", ctypes.c_char_p),
        ("size", ctypes.c_size_t),
        ("parts", ctypes.POINTER(Part)),
        ("count", ctypes.c_size_t),
        ("total", ctypes.c_size_t),
        ("taken", ctypes.c_void_p),
        ("taken_size", ctypes.c_size_t),
        ("program", ctypes.c_void_p),
        ("functions", ctypes.c_void_p),
    )
    views: Sequence[object] = ()
    """Memory that the parts point to."""


class Facts(ctypes.Structure):
    """Results of the functions of a handle; stored right before the handle's address."""

    _fields_ = (
        ("names", ctypes.c_char_p * 2),
        ("handles", ctypes.c_void_p * 2),
        ("hash", ctypes.c_void_p),
        ("description", ctypes.c_void_p),
        ("sources", ctypes.c_void_p),
        ("functions", ctypes.c_void_p),
    )


@cache
def functions() -> Functions:
    """Functions of libfastcdr 2 and of the C library.

    Those of Fast CDR have mangled names because it has no C interface, and `rmw_fastrtps_cpp` gives
    the callbacks of a type support a C++ object. `check` proves the names and the layout before the
    first type is made; the other way to a type without colcon would be another middleware
    (`rmw_fastrtps_dynamic_cpp`), which the wheels do not hold.

    Raises
    ------
    LayoutError
        Fast CDR is of another release.
    """
    libc = ctypes.CDLL(None)
    try:
        cdr = c.library("libfastcdr.so.2")
        found = (
            cdr["_ZN8eprosima7fastcdr3Cdr15serialize_arrayEPKcm"],
            cdr["_ZN8eprosima7fastcdr3Cdr18get_buffer_pointerEv"],
            cdr["_ZN8eprosima7fastcdr3Cdr20get_current_positionEv"],
            *(libc[name] for name in ("malloc", "free", "memcpy", "strcmp")),
        )
    except (OSError, AttributeError) as error:
        raise c.LayoutError(
            f"ROS types cannot be made at run time with this Fast CDR: {error}. Install the "
            "ros-jazzy wheels, or compile the types with colcon."
        ) from error
    return Functions(*(ctypes.cast(one, ctypes.c_void_p).value for one in found))


@cache
def entries() -> dict[str, int]:
    """Address of each function of native.c.

    Raises
    ------
    LayoutError
        There is no library of it, and no compiler to make one; or it cannot be loaded.
    """
    try:
        library = ctypes.CDLL(str(find_library()))
        return {name: _address(library[name]) for name in ENTRIES}
    except (LibraryError, OSError, AttributeError) as error:
        raise c.LayoutError(f"ROS types cannot be made at run time: {error}") from error


@cache
def release() -> Callable[[int], None]:
    """The function that frees memory allocated by `deserialize`; it keeps the GIL."""
    free = ctypes.PyDLL(None).free
    free.argtypes = (ctypes.c_void_p,)
    free.restype = None
    return free


@cache
def check() -> None:
    """Read and write bytes through Fast CDR, which the functions reach into.

    Raises
    ------
    LayoutError
        They do not come out as they went in: Fast CDR is of another release, or none of the ways
        to the functions is open.
    """
    sent = b"\0\1\0\0" + bytes(range(1, 9))
    size = len(sent) - _HEAD
    numbers = (ctypes.c_int64 * 6)(1, 1, size, 0, 0, 0)
    block = Block(program=ctypes.addressof(numbers), functions=ctypes.addressof(functions()))
    called = entries()
    of_two = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_void_p, ctypes.c_void_p)
    with_memory = ctypes.create_string_buffer(sent, len(sent))
    cdr = _cdr(with_memory)
    taken = b""
    if of_two(called["deserialize"])(cdr, ctypes.addressof(block)) and block.taken:
        taken = ctypes.string_at(block.taken, block.taken_size)
        release()(block.taken)
    block.data, block.size, block.total = taken[::-1], len(taken), len(taken)
    written = ctypes.create_string_buffer(sent[:_HEAD], len(sent))
    of_two(called["serialize"])(ctypes.addressof(block), _cdr(written))
    if taken != sent[_HEAD:] or written.raw[_HEAD:] != taken[::-1]:
        raise c.LayoutError(
            "ROS types cannot be made at run time with this Fast CDR, which is laid out as no 2.2 "
            "is. Install the ros-jazzy wheels, or compile the types with colcon."
        )


_HEAD = 4
"""Size of CDR's encapsulation [B]."""


def _cdr(memory: ctypes.Array[ctypes.c_char]) -> int:
    """Address of a Cdr behind the head of some memory."""
    library = c.library("libfastcdr.so.2")
    buffer = keep(ctypes.create_string_buffer(_ROOM))
    cdr = keep(ctypes.create_string_buffer(_ROOM))
    keep(memory)
    new_buffer = library["_ZN8eprosima7fastcdr10FastBufferC1EPcm"]
    new_buffer.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t)
    new_buffer(buffer, memory, len(memory))
    new = library["_ZN8eprosima7fastcdr3CdrC1ERNS0_10FastBufferENS1_10EndiannessENS0_10CdrVersionE"]
    new.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_int)
    new(cdr, buffer, 1, 1)  # little-endian, as in DDS
    read_head = library["_ZN8eprosima7fastcdr3Cdr18read_encapsulationEv"]
    read_head.argtypes = (ctypes.c_void_p,)
    read_head(cdr)
    return ctypes.addressof(cdr)


_ROOM = 4096
"""Upper bound of the size of a Cdr or its buffer [B]."""


def _address(function: object) -> int:
    found = ctypes.cast(function, ctypes.c_void_p).value  # type: ignore[arg-type]
    assert found is not None
    return found
