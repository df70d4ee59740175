"""The ports of two relays, joined in memory: announcements, answers, and a succeeding relay."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, closing, suppress
from pathlib import Path

import pytest

from rn_link import ports
from rn_link.machine import DISCOVERY_PORT, THERE
from rn_link.ports import ParticipantPort, Ports

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

    async def met(self) -> tuple[str, int]:
        """Data address of the participant that announces itself."""
        message = await self.receive(self.metatraffic)
        *_, port, address = struct.unpack("<HHiI12x4s", message[-28:])
        return socket.inet_ntoa(address), port

    def close(self) -> None:
        for one in (self.metatraffic, self.data):
            one.close()


class Relays:
    """Both machines' ports; messages forwarded by one are delivered by the other."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._folder, self._monkeypatch = folder, monkeypatch
        self.robot, self.gpu = self.open("robot"), self.open("gpu")

    def open(self, name: str) -> Ports:
        def forward(_: str | None, place: ParticipantPort, message: bytes) -> None:
            to = self.gpu if name == "robot" else self.robot
            to.deliver(name, place, message)

        self._monkeypatch.setattr(ports, "RELAY", RELAYS[name])
        return Ports(forward, self._folder / f"{name}.json")

    def close(self) -> None:
        self.robot.close()
        self.gpu.close()


async def meet(near: Participant, far: Participant) -> tuple[str, int]:
    """Address at which `far` reaches `near`."""
    far.announce(RELAYS["gpu"])
    await asyncio.sleep(0.05)  # until the relay knows it, as after a repeated announcement
    near.announce(RELAYS["robot"])
    place = await far.met()
    assert place[0] == THERE
    assert place[1] != near.place.port
    return place


@asynccontextmanager
async def cell(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[tuple[Relays, Participant, Participant]]:
    """Both relays, and a participant beside each."""
    with ExitStack() as stack:
        relays = Relays(folder, monkeypatch)
        stack.callback(lambda: relays.close())
        near, far = (stack.enter_context(closing(Participant(name))) for name in (b"near", b"far"))
        yield relays, near, far


def test_messages_reach_the_participant_that_announced_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario() -> None:
        async with cell(tmp_path, monkeypatch) as (relays, near, far):
            far.data.sendto(b"before", await meet(near, far))
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


def test_the_next_relay_has_the_ports_of_the_last_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario() -> None:
        async with cell(tmp_path, monkeypatch) as (relays, near, far):
            place = await meet(near, far)
            relays.close()
            relays.robot, relays.gpu = relays.open("robot"), relays.open("gpu")
            far.data.sendto(b"after", place)
            assert await near.receive(near.data) == b"after"

    asyncio.run(scenario())


@pytest.mark.parametrize("content", ["{", "[]", '{"here": {"x": "y"}}'])
def test_a_damaged_record_is_told_and_not_used(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    content: str,
) -> None:
    async def scenario() -> None:
        async with cell(tmp_path, monkeypatch) as (_, near, far):
            await meet(near, far)

    (tmp_path / "gpu.json").write_text(content)
    asyncio.run(scenario())
    assert "damaged" in caplog.text
