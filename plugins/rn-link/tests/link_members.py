"""A relay and members without ROS, on the event loop of a test."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import ssl
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

from rn_link import peer_link, ports
from rn_link import relay as relay_module
from rn_link.relay import Relay
from rn_link.state import PeerConnection

BOUND_S = 20.0


class Net:
    """Addresses of this test alone: the port of members, and the relay's for announcements."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        pid = os.getpid()
        self.relay = f"127.91.{pid >> 8 & 255}.{pid & 255}"
        with socket.create_server(("127.0.0.1", 0)) as listener:
            self.port = int(listener.getsockname()[1])
        for module, name, value in (
            (ports, "RELAY", self.relay),
            (peer_link, "PORT", self.port),
            (peer_link, "PAUSE_S", 0.05),
            (relay_module, "LOOK_S", 0.05),
        ):
            monkeypatch.setattr(module, name, value)

    def is_taken(self) -> bool:
        """True if a member listens."""
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0


@pytest.fixture
def net(monkeypatch: pytest.MonkeyPatch) -> Net:
    return Net(monkeypatch)


async def until(look: Callable[[], object], what: object) -> None:
    """Wait until `look` returns something true."""
    try:
        async with asyncio.timeout(BOUND_S):
            while not look():
                await asyncio.sleep(0.01)
    except TimeoutError as error:
        raise AssertionError(f"not within {BOUND_S} s: {what}") from error


@asynccontextmanager
async def relaying(folder: Path) -> AsyncIterator[None]:
    """Run the relay of a machine."""
    ended = asyncio.Event()
    task = asyncio.create_task(Relay(folder).run(ended))
    try:
        yield
    finally:
        ended.set()
        await task
        for _ in range(10):  # an abort of TLS takes several turns of the loop
            await asyncio.sleep(0)


def state_of(folder: Path, name: str) -> PeerConnection:
    """The connection to a machine as published by the relay."""
    with suppress(FileNotFoundError):
        return PeerConnection(**json.loads((folder / "relay.json").read_text()).get(name, {}))
    return PeerConnection()


@asynccontextmanager
async def listening(
    net: Net, context: ssl.SSLContext | None, address: str = "127.0.0.1", drops: int = 0
) -> AsyncIterator[list[bytes | None]]:
    """Accept connections of a hub; the first `drops` ones end right after their handshake.

    Yields:
        for each connection what it sent, as far as it has; None at its end.
    """
    heard: list[bytes | None] = []
    writers = []

    async def take(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        number = len(heard)
        heard.append(b"")
        writers.append(writer)
        if number < drops:
            writer.transport.abort()
        with suppress(OSError):
            while part := await reader.read(1000):
                heard[number] = (heard[number] or b"") + part
        heard[number] = None

    server = await asyncio.start_server(take, address, net.port, ssl=context)
    try:
        yield heard
    finally:
        server.close()
        for writer in writers:
            writer.transport.abort()
