"""The relay's part in ROS: announcements get addresses that represent another machine, messages to
these reach the participant that announced itself; everything else stays unchanged.
"""

from __future__ import annotations

import asyncio
import os
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, closing, suppress

import pytest

from rn_link import ports
from rn_link.machine import DISCOVERY_PORT
from rn_link.ports import ParticipantPort, Ports, address_of
from rn_link.rtps import domain_of, read_announcement, with_places

LOOPBACK = "127.0.0.1"
DOMAIN_PORTS = range(64_900, 65_150)
"""Ports of domain 230."""
PID = os.getpid()
RELAYS = {
    "robot": f"127.92.{PID >> 8 & 255}.{PID & 255}",
    "gpu": f"127.93.{PID >> 8 & 255}.{PID & 255}",
}
PARTICIPANT = b"a participan"
SPDP, SEDP, USER = (bytes.fromhex(text) for text in ("000100c2", "000003c2", "00001203"))
THERE = bytes((127, 90, 1, 2))
PLACES = dict.fromkeys(range(2**16), (THERE, 40000))
HERE = bytes((127, 0, 0, 1))


def locator(pid: int, port: int, address: bytes = HERE, kind: int = 1) -> bytes:
    return struct.pack("<HHiI12x4s", pid, 24, kind, port, address)


def data(writer: bytes, payload: bytes, kind: int = 0x15) -> bytes:
    body = struct.pack("<HH4s4sq", 0, 16, bytes(4), writer, 1) + b"\0\3\0\0" + payload
    return struct.pack("<BBH", kind, 5, len(body)) + body


def stamped(*submessages: bytes, of: bytes = PARTICIPANT) -> bytes:
    return b"RTPS\2\3\1\x0f" + of + struct.pack("<BBHq", 0x09, 1, 8, 0) + b"".join(submessages)


def test_a_participants_ports_are_read_and_its_address_changed() -> None:
    message = stamped(
        data(SPDP, locator(0x32, 7412) + locator(0x31, 7413) + locator(0x33, 7400)),
        data(SEDP, locator(0x2F, 7413)),
    )
    found = read_announcement(message)
    assert found.ports == {7412, 7413}
    assert found.metatraffic == {7412}
    assert found.domains == {0}
    assert found.participant == PARTICIPANT
    moved = with_places(message, {7412: (THERE, 40001), 7413: (THERE, 40002)})
    assert len(moved) == len(message)
    assert moved.count(THERE) == 3
    assert moved.count((40002).to_bytes(2, "little")) == 2
    assert with_places(moved, PLACES) == moved
    assert moved.count(HERE) == 1, "that of multicast"
    assert read_announcement(moved).ports == set()


@pytest.mark.parametrize(
    "message",
    [
        stamped(data(USER, locator(0x32, 7412))),
        stamped(data(SPDP, b"", kind=0x16)),
        stamped(data(SPDP, locator(0x32, 7412, kind=16))),
        stamped(data(SPDP, locator(0x31, 7413, bytes((10, 0, 0, 1))))),
    ],
    ids=["data of users", "fragment", "shared memory", "another address"],
)
def test_everything_else_stays_as_it_is(message: bytes) -> None:
    assert with_places(message, PLACES) == message
    assert not read_announcement(message).ports


def test_the_last_part_of_a_message_may_have_no_length() -> None:
    part = data(SPDP, locator(0x32, 7662))
    assert read_announcement(stamped(part[:2] + b"\0\0" + part[4:])).domains == {1}
    assert [domain_of(port) for port in (7410, 7649, 7650, 65410)] == [0, 0, 1, 232]


class Participant:
    """A ROS participant, as seen by the relay."""

    def __init__(self, name: str) -> None:
        self.name = f"{name}{PID}".encode().ljust(12, b"\0")
        self.metatraffic, self.data = (self._open() for _ in range(2))

    def _open(self) -> socket.socket:
        """Open the first free port of the domain."""
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.setblocking(False)
        for port in DOMAIN_PORTS:
            with suppress(OSError):  # the port is in use
                made.bind((LOOPBACK, port))
                return made
        made.close()
        raise OSError("no port of the domain is free")

    @property
    def place(self) -> ParticipantPort:
        return ParticipantPort(self.name, self.data.getsockname()[1])

    def announce(self, relay: str) -> None:
        places = ((0x32, self.metatraffic), (0x31, self.data))
        locators = b"".join(locator(pid, one.getsockname()[1]) for pid, one in places)
        self.data.sendto(stamped(data(SPDP, locators), of=self.name), (relay, DISCOVERY_PORT))

    async def receive(self, on: socket.socket) -> bytes:
        loop = asyncio.get_running_loop()
        return await asyncio.wait_for(loop.sock_recv(on, 65_536), 10.0)

    def close(self) -> None:
        for one in (self.metatraffic, self.data):
            one.close()


class Relays:
    """Both machines' ports; messages forwarded by one are delivered by the other."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._monkeypatch = monkeypatch
        self.robot, self.gpu = self.open("robot"), self.open("gpu")

    def open(self, name: str) -> Ports:
        def forward(_: str | None, place: ParticipantPort, message: bytes) -> None:
            to = self.gpu if name == "robot" else self.robot
            to.deliver(name, place, message)

        self._monkeypatch.setattr(ports, "RELAY", RELAYS[name])
        return Ports(forward)

    def close(self) -> None:
        self.robot.close()
        self.gpu.close()


async def meet(near: Participant, far: Participant) -> tuple[str, int]:
    """Address at which `far` reaches `near`."""
    far.announce(RELAYS["gpu"])
    # until the relay knows it, as after a repeated announcement
    await asyncio.sleep(0.05)
    near.announce(RELAYS["robot"])
    message = await far.receive(far.metatraffic)
    *_, port, address = struct.unpack("<HHiI12x4s", message[-28:])
    place = (socket.inet_ntoa(address), port)
    assert place == address_of("robot", near.place)
    return place


@asynccontextmanager
async def cell(
    monkeypatch: pytest.MonkeyPatch,
) -> AsyncIterator[tuple[Relays, Participant, Participant]]:
    """Both relays, and a participant beside each."""
    with ExitStack() as stack:
        relays = Relays(monkeypatch)
        stack.callback(lambda: relays.close())
        near, far = (stack.enter_context(closing(Participant(name))) for name in ("near", "far"))
        yield relays, near, far


def test_messages_reach_the_participant_that_announced_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also by the next relay, at the same address."""

    async def scenario() -> None:
        async with cell(monkeypatch) as (relays, near, far):
            place = await meet(near, far)
            relays.close()
            relays.robot, relays.gpu = relays.open("robot"), relays.open("gpu")
            assert await meet(near, far) == place
            far.data.sendto(b"before", place)
            assert await near.receive(near.data) == b"before"
            # an open port that no participant has announced
            relays.robot.deliver("gpu", ParticipantPort(near.name, far.place.port), b"elsewhere")
            # an earlier participant of that port
            relays.robot.deliver("gpu", ParticipantPort(b"x" * 12, near.place.port), b"late")
            relays.robot.deliver("gpu", near.place, b"right")
            assert await near.receive(near.data) == b"right"
            with pytest.raises(BlockingIOError):
                far.data.recv(100)

    asyncio.run(scenario())


@pytest.mark.parametrize(("limit", "value"), [("_MOST_PORTS", 0), ("_FORGOTTEN_S", -1.0)])
def test_ports_of_a_machine_are_few_and_forgotten(
    monkeypatch: pytest.MonkeyPatch, limit: str, value: float
) -> None:
    monkeypatch.setattr(ports, limit, value)

    async def scenario() -> None:
        async with cell(monkeypatch) as (relays, near, far):
            address = await meet(near, far)
            relays.gpu.forget()
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
                free.bind(address)

    asyncio.run(scenario())
