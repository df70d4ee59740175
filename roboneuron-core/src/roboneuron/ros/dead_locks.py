"""Locks in shared-memory ports whose holder was killed: released, so that nobody waits for the dead.

Fast DDS waits a second for such a lock, with each message anew, then makes the port anew: for several seconds those who
write there do nothing else (measured: robot, perception and control silent for more than three seconds).
"""

from __future__ import annotations

import ctypes
import fcntl
import logging
import mmap
import os
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from roboneuron.ros.port_record import LOCKS, find_record, lock_owner
from roboneuron.ros.segments import PORT_PREFIX, SHARED_MEMORY

log = logging.getLogger(__name__)
_LOOKS, _PAUSE_S = 5, 0.01
"""A living thread holds such a lock for microseconds. One that is not seen here may live in another container."""


def release_dead_locks(names: Iterable[str] | None = None, directory: Path = SHARED_MEMORY) -> int:
    """Release the locks of threads that are gone.

    Args:
        names: of the ports' files; None for every port of the machine that may be written.
        directory: where they are.

    Returns:
        How many were released.
    """
    released = 0
    for name in [path.name for path in directory.glob(f"{PORT_PREFIX}*")] if names is None else names:
        number = name.removeprefix(PORT_PREFIX)
        if number.isdecimal():
            with suppress(OSError, ValueError):  # gone, somebody else's, or empty: being made
                released += _release(directory / name, int(number))
    return released


def _release(path: Path, port: int) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        with mmap.mmap(descriptor, 0) as memory:
            if not _held_by_the_dead(memory, port):
                return 0
            fcntl.flock(descriptor, fcntl.LOCK_EX)  # two that release at once would release the lock of a living one
            held = _held_by_the_dead(memory, port)
            for _ in range(_LOOKS):
                time.sleep(_PAUSE_S)
                held &= _held_by_the_dead(memory, port)
            start = (ctypes.c_char * len(memory)).from_buffer(memory)
            try:
                for offset, owner in held:
                    log.warning("Thread %d died in the middle of a message to port %d: lock released.", owner, port)
                    ctypes.CDLL(None).pthread_mutex_unlock(ctypes.c_void_p(ctypes.addressof(start) + offset))
            finally:
                del start
            return len(held)
    finally:
        os.close(descriptor)


def _held_by_the_dead(memory: mmap.mmap, port: int) -> set[tuple[int, int]]:
    """Offsets and holders of locks whose holder is gone."""
    content = memory[:]
    record = find_record(content, port)
    if record is None:
        return set()
    locks = {(record.offset + lock, lock_owner(content, record.offset + lock)) for lock in LOCKS}
    return {(offset, owner) for offset, owner in locks if owner > 0 and not Path(f"/proc/{owner}").exists()}
