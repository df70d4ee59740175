"""Room in the TCP connections of this process to other machines, so that nobody waits for them.

A publisher sends to all its readers one after the other. Fast DDS drops what does not fit into
twice `sendBufferSize`, but the kernel's buffer of that size holds less, as it counts its own
overhead: the message between the two limits blocked the publisher, and its readers on the same
machine, until a cut cable was back (13 s measured). So the kernel's buffer is made twice as large.

Source: Fast DDS 2.14, TCPChannelResource::check_socket_send_buffer; tcp(7), proc(5).
"""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from rn_link.machine import link_folder, read_machine
from roboneuron import ConfigurationError
from roboneuron.feature import Periodic

if TYPE_CHECKING:
    from roboneuron.node import ModuleHost  # imports rclpy

log = logging.getLogger(__name__)
_LOOK_S = 0.1
"""A connection has room this long after it is made."""


def watch_connections(_: ModuleHost | None = None) -> None:
    """Watch this process's connections until it ends; every module process calls it once."""
    addresses = _addresses()
    if addresses:
        ConnectionWatch(addresses).start()


def _addresses() -> frozenset[str]:
    try:
        machine = read_machine(link_folder())
    except ConfigurationError:  # told by `join_link`
        return frozenset()
    return frozenset(peer.address for peer in machine.peers.values()) if machine else frozenset()


class ConnectionWatch(Periodic):
    """Gives connections to these addresses room, on a thread of its own from `start` to `close`."""

    def __init__(self, addresses: frozenset[str]) -> None:
        super().__init__("link-connections", _LOOK_S, self._look)
        self._addresses = addresses
        self._seen: frozenset[str] = frozenset()

    def _look(self) -> None:
        try:
            inodes = frozenset(_inodes(self._addresses))
            if inodes - self._seen:
                give_room(inodes - self._seen)
            self._seen = inodes
        except OSError as error:  # no /proc
            log.warning("Connections of the link may delay this process: %s", error)
            self.close()


def give_room(inodes: frozenset[str]) -> int:
    """Double the buffers of those connections that this process has; returns how many it has."""
    links = {f"socket:[{inode}]" for inode in inodes}
    found = 0
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # closed meanwhile
            if os.readlink(f"/proc/self/fd/{name}") in links:
                with closing(socket.socket(fileno=os.dup(int(name)))) as connection:
                    # the kernel reports, and makes, twice what it is asked for
                    now = connection.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, now)
                found += 1
    return found


def _inodes(addresses: frozenset[str]) -> Iterator[str]:
    """Inodes of this namespace's TCP sockets that are connected to these addresses.

    Addresses are hexadecimal words in the machine's byte order; state 01 is "established".
    """
    words = {f"{int.from_bytes(socket.inet_aton(one), sys.byteorder):08X}" for one in addresses}
    with Path("/proc/self/net/tcp").open(encoding="ascii") as lines:
        next(lines)
        for line in lines:
            fields = line.split()
            if fields[2].partition(":")[0] in words and fields[3] == "01":
                yield fields[9]
