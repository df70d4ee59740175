"""Release locks held by dead processes in Fast DDS ports, and silence the ports of dead processes.

A killed process may leave locks in the ports of other processes. Fast DDS waits a second for each,
with every message, and then recreates the port, which may receive nothing afterwards (see
`lost_ports`). In the dead process's own port, a sender finds after a second that the listener does
not respond, and recreates that port too (for possible consequences see Fast DDS issue 6484).
Measured without this module: a robot that reported nothing for three seconds after control had been
killed.
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
"""Time after which no process writes to a killed one: the lease of a participant is 20 s."""
_LOOKS, _PAUSE_S = 5, 0.01
"""Number and interval of checks of a lock: a living thread holds it for microseconds. An invisible
thread may live in another container.
"""


def release_dead_locks(names: Iterable[str] | None = None, directory: Path = SHARED_MEMORY) -> int:
    """Release the locks of threads that have ended.

    Args:
        names: names of the ports' files; None for every writable port of the machine.
        directory: their folder.

    Returns:
        The number of released locks.
    """
    released = 0
    for name in (
        [path.name for path in directory.glob(f"{PORT_PREFIX}*")] if names is None else names
    ):
        port = port_number(name)
        if port is not None:
            with suppress(OSError, ValueError):  # removed, of another user, or empty: new
                released += _release(directory / name, port)
    return released


class SilentPorts:
    """Ports of a dead process, made to discard messages without blocking the senders.

    They must not stay in that state: senders would never check the listener of a much later process
    that reuses such a port. `retire` marks them as broken for the processes that still have them
    open; by then no process may write to them any more.
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
            # an OSError if another process has the port by now
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
        """Make all processes close them."""
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
            # two processes that release at once would release the lock of a living one
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
    """Offsets and holders of locks whose holder has ended."""
    content = memory[:]
    record = find_record(content, port)
    if record is None:
        return set()
    locks = {(record.offset + lock, lock_owner(content, record.offset + lock)) for lock in LOCKS}
    return {(offset, owner) for offset, owner in locks if owner > 0 and not _may_hold(owner, port)}


def _may_hold(thread: int, port: int) -> bool:
    """True if the thread is alive and has that port mapped; thread ids are reused."""
    try:
        maps = Path(f"/proc/{thread}/maps").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return False
    except OSError:  # of another user
        return True
    return f"{PORT_PREFIX}{port}" in maps
