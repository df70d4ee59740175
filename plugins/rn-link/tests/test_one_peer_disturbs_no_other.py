"""Faults of one machine of a link: bad files, or a connection that ends at once. The others stay
connected.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from link_pairs import Place, admit, make_hub, pair

from rn_link import ports
from rn_link import relay as relay_module
from rn_link.machine import Peer, read_machine
from rn_link.relay import Relay
from rn_link.state import PeerConnection, StateFile
from rn_link.stream import LinkStream
from rn_link.tls import tls_context
from rn_testing.waiting import wait_until

BOUND_S = 20.0
pytestmark = pytest.mark.timeout(120)


States = dict[str, PeerConnection]


@pytest.fixture
def states(monkeypatch: pytest.MonkeyPatch) -> States:
    """Connections of the relay under test, by machine."""
    told: States = {}
    keep = StateFile._keep

    def note(file: StateFile, name: str, connection: PeerConnection) -> None:
        told[name] = connection
        keep(file, name, connection)

    monkeypatch.setattr(StateFile, "_keep", note)
    return told


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """A hub, whose relay looks often."""
    monkeypatch.setattr(ports, "RELAY", "127.90.0.5")
    monkeypatch.setattr(relay_module, "LOOK_S", 0.05)
    monkeypatch.setattr(relay_module, "_PAUSE_S", 0.05)
    make_hub(tmp_path / "robot")
    return Place("robot", tmp_path / "robot")


@contextmanager
def on_a_loop(main: Any) -> Iterator[None]:
    """Run `main(ended)` on a thread until the context ends; its error is raised there."""
    loop, ended = asyncio.new_event_loop(), asyncio.Event()
    errors: list[BaseException] = []

    async def settle() -> None:
        """Let the loop close what was aborted, and end what still runs."""
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        for _ in range(10):  # an abort of TLS takes several turns of the loop
            await asyncio.sleep(0)

    def run() -> None:
        try:
            loop.run_until_complete(main(ended))
        except Exception as error:
            errors.append(error)
        finally:
            loop.run_until_complete(settle())
            loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        if thread.is_alive():
            loop.call_soon_threadsafe(ended.set)
        thread.join(BOUND_S)
    assert not errors, errors


def free_port() -> int:
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


@contextmanager
def member(robot: Place, folder: Path, name: str) -> Iterator[None]:
    """A machine that accepts the hub's connections."""
    port = free_port()
    admit(robot.link, folder, name, Peer("127.0.0.1", port))
    machine = read_machine(folder)
    assert machine is not None
    context = tls_context(machine, folder, "robot")

    async def serve(ended: asyncio.Event) -> None:
        async def take(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writers.append(writer)
            with suppress(OSError):  # the hub ends it within the handshake, too
                # only here, so that a connection within its handshake is known and ended as well
                await writer.start_tls(context)
                while await reader.read(1000):
                    writer.write(bytes(16))  # a heartbeat

        writers: list[asyncio.StreamWriter] = []
        server = await asyncio.start_server(take, "127.0.0.1", port)
        await ended.wait()
        server.close()
        for writer in writers:
            writer.transport.abort()

    with on_a_loop(serve):
        yield


def relaying(robot: Place) -> AbstractContextManager[None]:
    """Run the relay of the hub until the context ends."""

    async def relay(ended: asyncio.Event) -> None:
        await Relay(robot.link).run(ended)

    return on_a_loop(relay)


def is_open(states: States, name: str) -> bool:
    return name in states and states[name].is_open


@pytest.mark.parametrize("content", [None, b"", b"no certificate"])
def test_a_bad_certificate_keeps_only_its_own_machine_out(
    robot: Place, tmp_path: Path, states: States, content: bytes | None
) -> None:
    with member(robot, tmp_path / "gpu", "gpu"), member(robot, tmp_path / "desk", "desk"):
        certificate = robot.link / "peers" / "desk.pem"
        good = certificate.read_bytes()
        certificate.unlink()
        if content is not None:
            certificate.write_bytes(content)
        with relaying(robot):
            wait_until(lambda: is_open(states, "gpu"), BOUND_S, "the other machine is connected")
            wait_until(lambda: "desk" in states, BOUND_S, "the reason is told")
            assert not states["desk"].is_open
            assert states["desk"].error.startswith("its keys cannot be used: ")
            assert "peers/desk.pem" in states["desk"].hint
            gpu = states["gpu"]
            certificate.write_bytes(good)
            wait_until(lambda: is_open(states, "desk"), BOUND_S, "the mended one is connected")
            assert states["gpu"] is gpu, "it stayed connected"


def test_an_certificate_that_becomes_bad_keeps_only_its_own_machine_out(
    robot: Place, tmp_path: Path, states: States
) -> None:
    with (
        member(robot, tmp_path / "gpu", "gpu"),
        member(robot, tmp_path / "desk", "desk"),
        relaying(robot),
    ):
        wait_until(lambda: is_open(states, "gpu"), BOUND_S, "gpu is connected")
        wait_until(lambda: is_open(states, "desk"), BOUND_S, "desk is connected")
        gpu = states["gpu"]
        (robot.link / "peers" / "desk.pem").write_bytes(b"")
        wait_until(lambda: "keys" in states["desk"].error, BOUND_S, "the reason is told")
        assert states["gpu"] is gpu, "it stayed connected"


def test_the_hub_connects_again_after_a_drop_right_after_the_handshake(
    robot: Place, tmp_path: Path, states: States, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts: list[PeerConnection | None] = []

    def stream(*words: Any) -> LinkStream:
        attempts.append(states.get("gpu"))
        if len(attempts) < 3:
            raise ConnectionError("the other side has ended it")
        return LinkStream(*words)

    monkeypatch.setattr(relay_module, "LinkStream", stream)
    with member(robot, tmp_path / "gpu", "gpu"), relaying(robot):
        wait_until(lambda: is_open(states, "gpu"), BOUND_S, "the hub has connected again")
    assert len(attempts) == 3
    told = attempts[1]
    assert told is not None
    assert "lost: " in told.error


def test_a_connection_that_has_ended_makes_no_stream(robot: Place, tmp_path: Path) -> None:
    gpu = Place("gpu", tmp_path / "gpu")
    pair(robot, gpu)
    hub, far = read_machine(robot.link), read_machine(gpu.link)
    assert hub is not None
    assert far is not None

    async def scenario() -> None:
        async def drop(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.transport.abort()

        server = await asyncio.start_server(
            drop, "127.0.0.1", 0, ssl=tls_context(far, gpu.link, "robot")
        )
        port = server.sockets[0].getsockname()[1]
        streams = await asyncio.open_connection(
            "127.0.0.1", port, ssl=tls_context(hub, robot.link, "gpu")
        )
        async with asyncio.timeout(BOUND_S):
            while streams[1].get_extra_info("socket") is not None:
                await asyncio.sleep(0)  # until asyncio has closed it
        with pytest.raises(ConnectionError, match="after the handshake"):
            LinkStream(*streams, lambda *_: None)
        server.close()

    asyncio.run(scenario())
