"""The ports of two relays, joined in memory: announcements, answers, and a succeeding relay."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, closing, suppress

import pytest

from rn_link import ports
from rn_link.machine import DISCOVERY_PORT
from rn_link.ports import ParticipantPort, Ports, address_of

SPDP = bytes.fromhex("000100c2")
LOOPBACK = "127.0.0.1"
DOMAIN_PORTS = range(64_900, 65_150)
"""Ports of domain 230."""
RELAYS = {"robot": "127.90.0.2", "gpu": "127.90.0.3"}


class Participant:
    """A ROS participant, as seen by the relay."""

    def __init__(self, name: bytes) -> None:
        self.name = name.ljust(12, b"\0")
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
        locators = b"".join(
            struct.pack("<HHiI12x4s", pid, 24, 1, one.getsockname()[1], bytes((127, 0, 0, 1)))
            for pid, one in ((0x32, self.metatraffic), (0x31, self.data))
        )
        body = struct.pack("<HH4s4sq", 0, 16, bytes(4), SPDP, 1) + b"\0\3\0\0" + locators
        message = b"RTPS\2\3\1\x0f" + self.name + struct.pack("<BBH", 0x15, 5, len(body)) + body
        self.data.sendto(message, (relay, DISCOVERY_PORT))

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
        near, far = (stack.enter_context(closing(Participant(name))) for name in (b"near", b"far"))
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
