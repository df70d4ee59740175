"""The TCP connections of this process to other machines, given up soon after a cable is cut.

A publisher sends to all its readers one after the other, so one whose connection takes no more data
delays those on the same machine. The kernel gives a silent connection up after 15 minutes, and Fast
DDS cannot tell it otherwise.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import closing, suppress
from typing import TYPE_CHECKING

from rn_link.machine import link_folder, read_machine
from roboneuron import ConfigurationError
from roboneuron.feature import Periodic

if TYPE_CHECKING:
    from roboneuron.node import ModuleHost  # imports rclpy

log = logging.getLogger(__name__)
GIVEN_UP_S = 1.0
"""A connection whose data nobody has acknowledged for this long is closed; a new one is tried with
every announcement (0.5 s).
"""
_LOOK_S = 0.25


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
    """Bounds the connections to these addresses, on a thread of its own from `start` to `close`."""

    def __init__(self, addresses: frozenset[str]) -> None:
        super().__init__("link-connections", _LOOK_S, self._look)
        self._addresses = addresses

    def _look(self) -> None:
        try:
            bound_connections(self._addresses)
        except OSError as error:  # no /proc
            log.warning("Connections of the link are not bounded: %s", error)
            self.close()


def bound_connections(addresses: frozenset[str]) -> int:
    """Have the kernel give connections to these addresses up after GIVEN_UP_S, also those that are
    being made: the kernel would ask again after ever longer times.

    Returns:
        How many there are.
    """
    links = {f"socket:[{inode}]" for inode in _inodes(addresses)}
    found = 0
    for name in os.listdir("/proc/self/fd") if links else ():
        with suppress(OSError):  # closed meanwhile
            if os.readlink(f"/proc/self/fd/{name}") in links:
                with closing(socket.socket(fileno=os.dup(int(name)))) as connection:
                    timeout_ms = int(GIVEN_UP_S * 1e3)
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, timeout_ms)
                found += 1
    return found


def _inodes(addresses: frozenset[str]) -> Iterator[str]:
    """Inodes of this namespace's TCP sockets that are or become connected to these addresses.

    Source: proc(5), /proc/net/tcp; addresses are hexadecimal words in the machine's byte order.
    """
    words = {f"{int.from_bytes(socket.inet_aton(one), sys.byteorder):08X}" for one in addresses}
    with open("/proc/self/net/tcp", encoding="ascii") as lines:
        next(lines)
        for line in lines:
            fields = line.split()
            if fields[2].partition(":")[0] in words:
                yield fields[9]
