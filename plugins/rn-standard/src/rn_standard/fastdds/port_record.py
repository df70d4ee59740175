"""Record at the beginning of a Fast DDS shared-memory port.

Source: Fast DDS 2.14.5, SharedMemGlobal::PortNode ("port_node_abi5") and
RobustInterprocessCondition; offsets measured on its files. Locks are `pthread_mutex_t` of glibc,
shared between processes and not robust.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

WAITING, FLAGS = 20, 24
"""Offsets of the number of waiters, and of the flags; the lowest flag means that the port works."""
IS_OK = 1
LOCKS = (20532, 20572)
"""Offsets of the waiters' lock, and of the port's own."""
LISTENER = 20612
"""Offset of the state of the first listener, the only one in a port of one process: in use (1),
waiting, processing.
"""
IN_USE = 1
_ABI = b"port_node_abi5"
_HEAD = struct.Struct("<7I")
_LOCK = struct.Struct("<iIiIi")
_PLAIN_SHARED = 128
"""Kind of a plain process-shared lock."""


class PortRecord(NamedTuple):
    """Offset of the record in the file, number of listeners, and flags."""

    offset: int
    listeners: int
    flags: int


def find_record(content: bytes, port: int) -> PortRecord | None:
    """Find the record of the port with that number; None for an unknown layout.

    It starts with the number, the listeners, two timeouts (the second a third of the first), the
    capacity, the number of waiters, and the flags.
    """
    offset = -1 if _ABI in content else len(content)
    while (offset := content.find(struct.pack("<I", port), offset + 1)) >= 0:
        if offset + LISTENER >= len(content):
            break
        _, listeners, check_ms, wait_ms, capacity, _, flags = _HEAD.unpack_from(content, offset)
        if check_ms > 0 and wait_ms == check_ms // 3 and 0 < capacity <= 2**16 and flags < 8:
            return PortRecord(offset, listeners, flags)
    return None


def lock_owner(content: bytes, offset: int) -> int:
    """Thread that holds the lock at `offset`; 0 if it is free, or not such a lock."""
    locked, _, owner, _, kind = _LOCK.unpack_from(content, offset)
    return int(owner) if locked and kind == _PLAIN_SHARED else 0
