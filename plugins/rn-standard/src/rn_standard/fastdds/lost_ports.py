"""Detection and repair of lost shared-memory ports: a process listens to one, but others open
another file of the same name.

A process that is killed in the middle of a message leaves a lock in the receiver's port. After a
second all processes recreate that port, its owner included, and sometimes one of them removes the
file that the owner has just created (Fast DDS 2.14; seen once in about 300 kills). Processes that
open the port afterwards write to another file of the same name: the owner receives nothing from
them, without any other symptom. The owner's listener reopens the port if the file that it waits on
is marked as broken. Nothing else marks a file without a name, so this module does.
"""

from __future__ import annotations

import logging
import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rn_standard.fastdds.dead_ports import release_dead_locks
from rn_standard.fastdds.port_record import FLAGS, IS_OK, find_record
from rn_standard.fastdds.segments import PORT_PREFIX, SHARED_MEMORY, owned_segments, port_number
from roboneuron.feature import Periodic

if TYPE_CHECKING:
    from roboneuron.feature import ModuleHost  # imports rclpy, for which no `initialize` waits

log = logging.getLogger(__name__)
LOOK_S = 0.5


@dataclass(frozen=True, slots=True)
class _PortRecord:
    """A port's record in this process's memory: the file's inode, the address of its flags, and its
    content.
    """

    inode: int
    flags_at: int
    flags: int
    listeners: int


def _records(port: int, memory: int) -> Iterator[_PortRecord]:
    """Records of all files of that port that this process has mapped.

    Args:
        memory: descriptor of /proc/self/mem; reading memory that was unmapped meanwhile is an
            OSError.
    """
    with open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
        lines = [line.split() for line in maps if f"/{PORT_PREFIX}{port}" in line]
    for addresses, _, _, _, inode, path, *_ in lines:
        if path != f"{SHARED_MEMORY}/{PORT_PREFIX}{port}":
            continue
        start, end = (int(address, 16) for address in addresses.split("-"))
        with suppress(OSError):
            found = find_record(os.pread(memory, end - start, start), port)
            if found is not None:
                yield _PortRecord(
                    int(inode), start + found.offset + FLAGS, found.flags, found.listeners
                )


class LostPorts:
    """Monitors the ports of this process; not thread-safe."""

    def __init__(self) -> None:
        self._good: dict[int, int] = {}
        self._doubtful: set[int] = set()

    def look(self) -> list[int]:
        """Repair the ports that are lost for the second check in a row (the first may be a change
        in progress).

        Locks in them held by a killed process are released first.

        Returns:
            Their numbers.
        """
        names = owned_segments(os.getpid())
        release_dead_locks(names)
        ports = {port for port in map(port_number, names) if port is not None}
        self._good = {port: inode for port, inode in self._good.items() if port in ports}
        lost = {port for port in ports if self._is_lost(port)}
        given_back = [port for port in sorted(lost & self._doubtful) if self._give_back(port)]
        self._doubtful = lost - set(given_back)
        return given_back

    def _is_lost(self, port: int) -> bool:
        inode = _inode(port)
        if inode is not None and self._good.get(port) == inode:
            return False
        memory = os.open("/proc/self/mem", os.O_RDONLY | os.O_CLOEXEC)
        try:
            heard = {record.inode for record in _records(port, memory) if record.listeners > 0}
        finally:
            os.close(memory)
        if inode is not None and inode in heard:
            self._good[port] = inode
            return False
        return bool(heard)

    def _give_back(self, port: int) -> bool:
        """Mark the unnamed file that is listened to as broken; its listener checks within a third
        of a second.
        """
        memory = os.open("/proc/self/mem", os.O_RDWR | os.O_CLOEXEC)
        marked = False
        try:
            for record in _records(port, memory):
                if record.listeners > 0 and record.inode != _inode(port) and record.flags & IS_OK:
                    with suppress(OSError):
                        os.pwrite(memory, struct.pack("<I", record.flags & ~IS_OK), record.flags_at)
                        marked = True
        finally:
            os.close(memory)
        return marked


def _inode(port: int) -> int | None:
    try:
        return (SHARED_MEMORY / f"{PORT_PREFIX}{port}").stat().st_ino
    except FileNotFoundError:
        return None


class PortWatch(Periodic):
    """Monitors this process's ports on a background thread, from `start` to `close`."""

    def __init__(self) -> None:
        super().__init__("lost-ports", LOOK_S, self._look)
        self._ports = LostPorts()

    def _look(self) -> None:
        try:
            given_back = self._ports.look()
        except OSError as error:  # no /proc, or not writable: Fast DDS stays as it is
            log.warning("Shared-memory ports are not looked after: %s", error)
            self.close()
            return
        for port in given_back:
            log.warning("Port %d had lost its file in shared memory, and was opened again.", port)


def watch_ports(_: ModuleHost) -> None:
    """Monitor this process's ports until its end; every module process calls it once."""
    PortWatch().start()
