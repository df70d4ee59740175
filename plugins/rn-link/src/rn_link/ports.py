"""The loopback ports of the relay: they receive messages of this machine's ROS, and deliver those
of other machines.
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from rn_link.machine import DISCOVERY_PORT, LOOPBACK, RELAY, THERE, check_name, write_state
from rn_link.rtps import Announcement, domain_of, read_announcement, with_places
from roboneuron import ConfigurationError, ForeignDataError, foreign

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


class Ports:
    """Receives messages of this machine's participants, and delivers those of other machines.

    All methods are called on the event loop.

    Args:
        forward: called with messages for other machines.
        record: file with the ports; participants do not repeat the announcements of their readers'
            ports, so the next relay needs the file.
    """

    def __init__(self, forward: Forward, record: Path) -> None:
        self._forward = forward
        self._record = record
        self._loop = asyncio.get_running_loop()
        self._discovery = _open(RELAY, DISCOVERY_PORT)
        self._sender = _open(LOOPBACK, 0)
        # participant that last announced each port
        self._here: dict[int, bytes] = {}
        self._metatraffic: set[int] = set()
        self._there: dict[tuple[str, ParticipantPort], socket.socket] = {}
        # time at which each participant, of this or another machine, last announced a port
        self._seen_s: dict[bytes, float] = {}
        self._saved = ""
        self._loop.add_reader(self._discovery, self._take_announcements)
        self._restore()

    def deliver(self, machine: str, place: ParticipantPort, message: bytes) -> None:
        """Deliver a message of another machine to this machine's participants.

        Only announced ports receive messages, so that a peer can reach nothing but ROS.
        """
        announced = read_announcement(message)
        if announced.ports:
            message = with_places(message, self._places(machine, announced))
        if place != DISCOVERY:
            if self._here.get(place.port) == place.participant:
                self._send(place.port, message)
            return
        domains = announced.domains
        for one in self._metatraffic:
            if not domains or domain_of(one) in domains:
                self._send(one, message)

    def forget(self) -> None:
        """Close the ports of participants without recent announcements."""
        before_s = time.monotonic() - _FORGOTTEN_S
        for participant in [one for one, seen_s in self._seen_s.items() if seen_s < before_s]:
            del self._seen_s[participant]
        for port, participant in list(self._here.items()):
            if participant not in self._seen_s:
                del self._here[port]
                self._metatraffic.discard(port)
        for key, made in list(self._there.items()):
            if key[1].participant not in self._seen_s:
                del self._there[key]
                self._close(made)
        self._save()

    def close(self) -> None:
        """Close all ports."""
        for made in self._there.values():
            self._close(made)
        self._there.clear()
        self._close(self._discovery)
        self._sender.close()

    def _take_announcements(self) -> None:
        for message in _received(self._discovery):
            self._metatraffic |= self._note(message).metatraffic
            self._forward(None, DISCOVERY, message)

    def _note(self, message: bytes) -> Announcement:
        """Record the ports announced by one of this machine's participants; a reader may have its
        own port.
        """
        announced = read_announcement(message)
        if announced.ports:
            self._seen_s[announced.participant] = time.monotonic()
            found = dict.fromkeys(announced.ports, announced.participant)
            if not found.items() <= self._here.items():
                self._here |= found
                self._save()
        return announced

    def _places(self, machine: str, announced: Announcement) -> dict[int, tuple[bytes, int]]:
        """Local addresses of another machine's participant for this machine's participants, by its
        remote port.
        """
        found = {}
        self._seen_s[announced.participant] = time.monotonic()
        for port in announced.ports:
            made = self._port_for(machine, ParticipantPort(announced.participant, port))
            if made is not None:
                address, here = made.getsockname()
                found[port] = (socket.inet_aton(address), here)
        return found

    def _port_for(self, machine: str, place: ParticipantPort) -> socket.socket | None:
        key = (machine, place)
        if key in self._there:
            return self._there[key]
        if sum(name == machine for name, _ in self._there) >= _MOST_PORTS:
            log.warning("%s announces more than %d ports.", machine, _MOST_PORTS)
            return None
        made = self._make_port(machine, place, 0)
        self._save()
        return made

    def _make_port(self, machine: str, place: ParticipantPort, port: int) -> socket.socket | None:
        try:
            made = _open(THERE, port)
        except OSError as error:
            log.warning("A port for %s cannot be opened: %s", machine, error)
            return None
        self._loop.add_reader(made, self._take, machine, place, made)
        self._there[machine, place] = made
        return made

    def _save(self) -> None:
        facts = {
            "here": {port: participant.hex() for port, participant in self._here.items()},
            "metatraffic": sorted(self._metatraffic),
            "there": [
                [machine, place.participant.hex(), place.port, made.getsockname()[1]]
                for (machine, place), made in self._there.items()
            ],
        }
        text = json.dumps(facts)
        if text != self._saved:
            write_state(self._record, text)
            self._saved = text

    def _restore(self) -> None:
        """Restore the ports of an earlier relay; participants that still run announce
        themselves.
        """
        try:
            facts = foreign.read_json(self._record, most_bytes=1 << 20)
            here = {
                _port(foreign.decode_json(port, "a port")): foreign.octets(one, "a participant")
                for port, one in foreign.table(foreign.field(facts, "here"), "here").items()
            }
            there = []
            for one in foreign.items(foreign.field(facts, "there"), "there", most=65_536):
                machine, participant, port, own = foreign.items(one, "a port", least=4, most=4)
                place = ParticipantPort(foreign.octets(participant, "a participant"), _port(port))
                there.append((check_name(foreign.text(machine, "a machine")), place, _port(own)))
            listed = foreign.items(foreign.field(facts, "metatraffic"), "metatraffic", most=65_536)
            metatraffic = {_port(port) for port in listed}
        except FileNotFoundError:
            return
        except (ForeignDataError, ConfigurationError) as error:
            log.warning("%s is damaged; ROS starts discovery again: %s", self._record, error)
            return
        self._here |= here
        self._metatraffic |= metatraffic
        for machine, place, own in there:
            self._make_port(machine, place, own)
        participants = [*here.values(), *(place.participant for _, place, _ in there)]
        self._seen_s |= dict.fromkeys(participants, time.monotonic())

    def _take(self, machine: str, place: ParticipantPort, made: socket.socket) -> None:
        for message in _received(made):
            self._note(message)
            self._forward(machine, place, message)

    def _send(self, port: int, message: bytes) -> None:
        # a participant that has ended or is overloaded: UDP may lose messages
        with suppress(BlockingIOError, ConnectionRefusedError):
            self._sender.sendto(message, (LOOPBACK, port))

    def _close(self, made: socket.socket) -> None:
        self._loop.remove_reader(made)
        made.close()


def _port(value: object) -> int:
    return foreign.integer(value, "a port", 1, 65_535)


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


def _received(made: socket.socket) -> list[bytes]:
    messages: list[bytes] = []
    with suppress(BlockingIOError):
        while len(messages) < _AT_ONCE:
            messages.append(made.recv(_MOST_BYTES))
    return messages
