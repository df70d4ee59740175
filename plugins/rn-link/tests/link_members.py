"""Members without ROS: the TLS part of another machine, and a hub's relay, each on a loop of its
own.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from link_pairs import Place, admit, make_hub

from rn_link import ports
from rn_link import relay as relay_module
from rn_link.machine import Peer, read_machine
from rn_link.relay import Relay
from rn_link.tls import tls_context

BOUND_S = 20.0


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """A hub of this machine, whose relay looks often."""
    monkeypatch.setattr(ports, "RELAY", "127.90.0.5")
    monkeypatch.setattr(relay_module, "LOOK_S", 0.05)
    monkeypatch.setattr(relay_module, "PAUSE_S", 0.05)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "robot"))
    place = Place("robot", tmp_path / "robot" / "roboneuron" / "link")
    make_hub(place.link)
    return place


@contextmanager
def on_a_loop(main: Callable[[asyncio.Event], Coroutine[Any, Any, None]]) -> Iterator[None]:
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


def admit_at_a_port(robot: Place, folder: Path, name: str) -> int:
    """Pair a member of this machine, and return the port at which it is to listen."""
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        port = int(made.getsockname()[1])
    admit(robot.link, folder, name, Peer("127.0.0.1", port))
    return port


@contextmanager
def answering(folder: Path, port: int, drops: int = 0) -> Iterator[None]:
    """Accept the hub's connections as the member of that folder; the first ones are aborted right
    after their handshake.
    """
    machine = read_machine(folder)
    assert machine is not None
    context = tls_context(machine, folder, "robot")
    writers: list[asyncio.StreamWriter] = []

    async def serve(ended: asyncio.Event) -> None:
        async def take(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writers.append(writer)
            with suppress(OSError):  # the hub ends it within the handshake, too
                # only here, so that a connection within its handshake is known and ended as well
                await writer.start_tls(context)
                if len(writers) <= drops:
                    writer.transport.abort()
                while await reader.read(1000):
                    pass

        server = await asyncio.start_server(take, "127.0.0.1", port)
        await ended.wait()
        server.close()
        for writer in writers:
            writer.transport.abort()

    with on_a_loop(serve):
        yield


@contextmanager
def relaying(robot: Place) -> Iterator[None]:
    """Run the relay of the hub until the context ends."""

    async def relay(ended: asyncio.Event) -> None:
        await Relay(robot.link).run(ended)

    with on_a_loop(relay):
        yield
