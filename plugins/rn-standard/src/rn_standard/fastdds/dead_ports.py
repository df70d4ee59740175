"""What a killed process leaves in shared-memory ports, put right before anybody waits for it.

Locks that it held in its neighbours' ports: Fast DDS waits a second for each, with each message
anew, and then makes the port anew, from which it may come out deaf (see `lost_ports`). Its own
port: who writes there finds after a second that its listener does not move, and makes that port
anew too (for what can go wrong then see Fast DDS issue 6484). Measured without this: a robot that
reported nothing for three seconds after control had been killed.
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

from rn_standard.fastdds.port_record import (
    FLAGS,
    IN_USE,
    IS_OK,
    LISTENER,
    LOCKS,
    WAITING,
    find_record,
    lock_owner,
)
from rn_standard.fastdds.segments import LOCK_SUFFIX, PORT_PREFIX, SHARED_MEMORY, port_number

log = logging.getLogger(__name__)
LEASE_S = 25.0
"""After this long nobody writes to a killed process any more: the lease of a participant is 20 s.
"""
_LOOKS, _PAUSE_S = 5, 0.01
"""A living thread holds such a lock for microseconds. One that is not seen here may live in another
container.
"""


def release_dead_locks(names: Iterable[str] | None = None, directory: Path = SHARED_MEMORY) -> int:
    """Release the locks of threads that are gone.

    Args:
        names: of the ports' files; None for every port of the machine that may be written.
        directory: where they are.

    Returns:
        How many were released.
    """
    released = 0
    for name in (
        [path.name for path in directory.glob(f"{PORT_PREFIX}*")] if names is None else names
    ):
        port = port_number(name)
        if port is not None:
            with suppress(OSError, ValueError):  # gone, somebody else's, or empty: being made
                released += _release(directory / name, port)
    return released


class SilentPorts:
    """The ports of a process that is gone, as places where messages vanish without anybody waiting.

    They must not stay so: a successor at one of these ports, long after, would not be looked for.
    `retire` tells those who still have them open that they are broken; by then nobody may write
    there any more.
    """

    def __init__(self, names: Iterable[str], directory: Path = SHARED_MEMORY) -> None:
        self._ports: list[tuple[mmap.mmap, int]] = []
        for name in names:
            port = port_number(name)
            if port is not None:
                with suppress(OSError, ValueError):
                    self._silence(directory / name, port)

    def _silence(self, path: Path, port: int) -> None:
        with (
            path.with_name(f"{path.name}{LOCK_SUFFIX}").open("rb") as lock,
            path.open("r+b") as file,
        ):
            # an OSError when somebody else has the port by now
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            memory = mmap.mmap(file.fileno(), 0)
        record = find_record(memory[:], port)
        if record is None or record.listeners != 1 or not memory[record.offset + LISTENER] & IN_USE:
            memory.close()
            return
        memory[record.offset + LISTENER] = IN_USE
        memory[record.offset + WAITING : record.offset + WAITING + 4] = bytes(4)
        self._ports.append((memory, record.offset))

    def retire(self) -> None:
        """Have everybody close them."""
        for memory, offset in self._ports:
            memory[offset + FLAGS] &= ~IS_OK & 0xFF
            memory.close()
        self._ports = []


def _release(path: Path, port: int) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        with mmap.mmap(descriptor, 0) as memory:
            if not _held_by_the_dead(memory, port):
                return 0
            # two that release at once would release the lock of a living one
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            held = _held_by_the_dead(memory, port)
            for _ in range(_LOOKS):
                time.sleep(_PAUSE_S)
                held &= _held_by_the_dead(memory, port)
            start = (ctypes.c_char * len(memory)).from_buffer(memory)
            try:
                for offset, owner in held:
                    log.warning(
                        "Thread %d died in the middle of a message to port %d: lock released.",
                        owner,
                        port,
                    )
                    ctypes.CDLL(None).pthread_mutex_unlock(
                        ctypes.c_void_p(ctypes.addressof(start) + offset)
                    )
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
    return {(offset, owner) for offset, owner in locks if owner > 0 and not _may_hold(owner, port)}


def _may_hold(thread: int, port: int) -> bool:
    """Whether the thread lives and has that port mapped; the number of a dead one is given to
    somebody else.
    """
    try:
        maps = Path(f"/proc/{thread}/maps").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return False
    except OSError:  # somebody else's
        return True
    return f"{PORT_PREFIX}{port}" in maps
