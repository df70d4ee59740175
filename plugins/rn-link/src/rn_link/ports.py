"""The loopback ports of the relay: they receive messages of this machine's ROS, and deliver those
of other machines.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from rn_link.machine import DISCOVERY_PORT, LOOPBACK, RELAY
from rn_link.rtps import Announcement, domain_of, read_announcement, with_places

log = logging.getLogger(__name__)
PARTICIPANT_BYTES = 12
_BUFFER_BYTES = 4_194_304
_MOST_BYTES = 65_536
_MOST_PORTS = 512
"""Limit of ports of one machine: a ROS participant has three."""
_FORGOTTEN_S = 60.0
"""Three times the lease of a participant; a running one announces its ports twice a second."""
_AT_ONCE = 64
"""Datagrams read from a socket before other sockets are served."""
_FIRST_PORT = DISCOVERY_PORT - 255


class ParticipantPort(NamedTuple):
    """Port at which a participant receives messages.

    A participant may reuse the port of a killed one, to which others send for another 20 s; Fast
    DDS 2.14 hangs in a large message whose first part arrived before the two had discovered each
    other. So the port alone does not identify the participant.
    """

    participant: bytes
    port: int


Forward = Callable[[str | None, ParticipantPort, bytes], None]
"""Called with the machine (None for all), the port on it or DISCOVERY, and the message."""
DISCOVERY = ParticipantPort(bytes(PARTICIPANT_BYTES), 0)
"""All participants of the domain."""


def address_of(machine: str, place: ParticipantPort) -> tuple[str, int]:
    """Local address that represents the port of another machine's participant: the same at every
    relay, so that the next one needs no memory of the last.
    """
    digest = hashlib.sha256(f"{machine} {place.port} ".encode() + place.participant).digest()
    # 30 bits; apart from RELAY and LOOPBACK, and below the ports of ROS
    host = bytes((127, 128 | digest[0] & 63, *digest[1:3]))
    return socket.inet_ntoa(host), _FIRST_PORT + digest[3]


class Ports:
    """Receives messages of this machine's participants, and delivers those of other machines.

    All methods are called on the event loop.

    Args:
        forward: called with messages for other machines.
    """

    def __init__(self, forward: Forward) -> None:
        self._forward = forward
        self._loop = asyncio.get_running_loop()
        # participant that last announced each port
        self._here: dict[int, bytes] = {}
        self._metatraffic: set[int] = set()
        self._there: dict[tuple[str | None, ParticipantPort], socket.socket] = {}
        # time at which each participant, of this or another machine, last announced a port
        self._seen_s: dict[bytes, float] = {}
        self._sender = _open(LOOPBACK, 0)
        self._listen(None, DISCOVERY, (RELAY, DISCOVERY_PORT))

    def deliver(self, machine: str, place: ParticipantPort, message: bytes) -> None:
        """Deliver a message of another machine to this machine's participants.

        Only announced ports receive messages, so that a peer can reach nothing but ROS.
        """
        announced = read_announcement(message)
        if announced.ports:
            message = with_places(message, self._places(machine, announced))
        if place == DISCOVERY:
            domains = announced.domains
            to = [one for one in self._metatraffic if not domains or domain_of(one) in domains]
        else:
            to = [place.port] if self._here.get(place.port) == place.participant else []
        for port in to:
            # a participant that has ended or is overloaded: UDP may lose messages
            with suppress(BlockingIOError, ConnectionRefusedError):
                self._sender.sendto(message, (LOOPBACK, port))

    def forget(self) -> None:
        """Close the ports of participants without recent announcements."""
        before_s = time.monotonic() - _FORGOTTEN_S
        self._seen_s = {one: seen_s for one, seen_s in self._seen_s.items() if seen_s >= before_s}
        self._here = {port: one for port, one in self._here.items() if one in self._seen_s}
        self._metatraffic &= self._here.keys()
        for key in [*self._there]:
            if key[1] != DISCOVERY and key[1].participant not in self._seen_s:
                self._close(self._there.pop(key))

    def close(self) -> None:
        """Close all ports."""
        for made in self._there.values():
            self._close(made)
        self._sender.close()

    def _places(self, machine: str, announced: Announcement) -> dict[int, tuple[bytes, int]]:
        """Local addresses of another machine's participant, by its port there."""
        found = {}
        self._seen_s[announced.participant] = time.monotonic()
        for port in announced.ports:
            place = ParticipantPort(announced.participant, port)
            host, here = address_of(machine, place)
            found[port] = socket.inet_aton(host), here
            if (machine, place) in self._there:
                continue
            if sum(name == machine for name, _ in self._there) >= _MOST_PORTS:
                log.warning("%s announces more than %d ports.", machine, _MOST_PORTS)
                continue
            try:
                self._listen(machine, place, (host, here))
            except OSError as error:
                log.warning("A port for %s cannot be opened: %s", machine, error)
        return found

    def _listen(self, machine: str | None, place: ParticipantPort, at: tuple[str, int]) -> None:
        """Receive messages for a port of another machine, or announcements for all machines."""
        made = _open(*at)
        self._loop.add_reader(made, self._take, machine, place, made)
        self._there[machine, place] = made

    def _take(self, machine: str | None, place: ParticipantPort, made: socket.socket) -> None:
        with suppress(BlockingIOError):
            for _ in range(_AT_ONCE):
                message = made.recv(_MOST_BYTES)
                announced = read_announcement(message)
                if announced.ports:  # a reader may have its own
                    self._seen_s[announced.participant] = time.monotonic()
                    self._here |= dict.fromkeys(announced.ports, announced.participant)
                    self._metatraffic |= announced.metatraffic
                self._forward(machine, place, message)

    def _close(self, made: socket.socket) -> None:
        self._loop.remove_reader(made)
        made.close()


def _open(address: str, port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        made.bind((address, port))
    except OSError:
        made.close()
        raise
    return made
