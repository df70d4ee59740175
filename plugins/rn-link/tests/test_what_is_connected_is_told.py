"""For every paired machine `link show` and `doctor` report whether it is connected, according to
the relay.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import json
import os
import socket
import ssl
from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from link_pairs import Place, admit, make_hub, pair

from rn_link import ports
from rn_link.command import LinkCommand, spoken
from rn_link.machine import Machine as Paired
from rn_link.machine import Peer, read_machine
from rn_link.relay import Relay
from rn_link.state import LOCK, STATE, PeerConnection, StateFile, hint_for, read_connections
from rn_link.tls import tls_context

BOUND_S = 20.0
HUB = Paired(name="robot", role="hub", peers={"gpu": Peer("10.0.0.2", 7411)})


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """This machine, a hub."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "robot"))
    return Place("robot", tmp_path / "robot" / "roboneuron" / "link")


@pytest.fixture
def gpu(tmp_path: Path) -> Place:
    """A member."""
    return Place("gpu", tmp_path / "gpu" / "roboneuron" / "link")


@contextmanager
def relay_lock(place: Place) -> Iterator[None]:
    """Hold the lock, as a running relay does."""
    lock = os.open(place.link / LOCK, os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        yield
    finally:
        os.close(lock)


def free_port() -> int:
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


def show(capsys: pytest.CaptureFixture[str], *options: str) -> str:
    parser, command = ArgumentParser(), LinkCommand()
    command.configure(parser)
    assert command.run(parser.parse_args(["show", *options])) == 0
    return capsys.readouterr().out


def test_without_a_relay_nothing_is_connected(
    robot: Place, gpu: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    pair(robot, gpu)
    StateFile(robot.link).connected("gpu")  # of a killed relay
    assert read_connections(robot.link) is None
    assert "No relay is running: start RoboNeuron, or `roboneuron link run`." in show(capsys)
    assert json.loads(show(capsys, "--json"))["connections"] is None
    ((is_well, text, hint),) = LinkCommand().findings()
    assert (is_well, text) == (False, "The link to gpu is down: no relay is running.")
    assert "`roboneuron link run`" in hint


def test_a_machine_without_a_link_has_no_findings(robot: Place) -> None:
    assert list(LinkCommand().findings()) == []


def test_each_machine_is_told_with_its_time_or_its_error(
    robot: Place, gpu: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    pair(robot, gpu)
    for name in ("desk", "lab"):
        admit(robot.link, robot.link.parent / name, name, Peer("10.0.0.9"))
    state = StateFile(robot.link)
    state.connected("gpu")
    state.unconnected("desk", "no answer", "Is desk on?")
    with relay_lock(robot):
        lines = show(capsys).splitlines()
        assert lines[1].startswith("gpu    127.0.0.1, TCP 7411; connected for 0 min ")
        assert lines[2].endswith("; NOT connected: no answer")
        assert lines[3].strip() == "Is desk on?"
        assert lines[4].endswith("; NOT connected: it is being connected")
        found = json.loads(show(capsys, "--json"))["connections"]
        assert found["desk"] == {"since": "", "error": "no answer", "hint": "Is desk on?"}
        verdicts = {
            text.split()[2]: (is_well, hint) for is_well, text, hint in LinkCommand().findings()
        }
    assert verdicts == {
        "gpu": (True, ""),
        "desk": (False, "Is desk on?"),
        "lab": (False, "Check again in a moment."),
    }
    state.forget("gpu")
    assert "gpu" not in json.loads((robot.link / STATE).read_text())


def test_hours_are_told_as_hours() -> None:
    now = datetime(2026, 11, 26, 12, 0, 0, tzinfo=UTC)
    since = (now - timedelta(hours=26, minutes=5)).isoformat(timespec="seconds")
    assert spoken(PeerConnection(since=since), now) == (
        "connected for 26 h 5 min, since 2026-11-25 09:55:00 UTC"
    )


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ConnectionRefusedError(), "Start RoboNeuron on gpu"),
        (TimeoutError(), "Is gpu on, 10.0.0.2 its address, and its TCP port 7411 open?"),
        (OSError(errno.EHOSTUNREACH, "no route"), "Is gpu on, 10.0.0.2"),
        (ssl.SSLError("alert unknown ca"), "Pair it again: "),
        (OSError("else"), "Check gpu and the network"),
    ],
)
def test_every_error_has_something_to_do(error: OSError, told: str) -> None:
    assert told in hint_for(HUB, "gpu", error)


async def until(folder: Path, is_open: bool, error: str = "") -> PeerConnection:
    """The state of the connection to the member, once it is as expected."""
    async with asyncio.timeout(BOUND_S):
        while True:
            one = (read_connections(folder) or {}).get("gpu", PeerConnection())
            if one.is_open is is_open and error in one.error and (is_open or one.error):
                return one
            await asyncio.sleep(0.02)


def test_the_relay_tells_what_becomes_of_a_connection(
    robot: Place, gpu: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "RELAY", "127.90.0.4")
    port = free_port()
    make_hub(robot.link)
    admit(robot.link, gpu.link, "gpu", Peer("127.0.0.1", port))
    member = read_machine(gpu.link)
    assert member is not None

    async def serve() -> Any:
        """The TLS part of the other machine."""

        async def take(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            taken.append(writer)

        context = tls_context(member, gpu.link, "robot")
        return await asyncio.start_server(take, "127.0.0.1", port, ssl=context)

    taken: list[asyncio.StreamWriter] = []

    async def scenario() -> None:
        ended = asyncio.Event()
        relay = asyncio.ensure_future(Relay(robot.link).run(ended))
        try:
            refused = await until(robot.link, is_open=False)
            assert "Start RoboNeuron on gpu" in refused.hint
            server = await serve()
            linked = await until(robot.link, is_open=True)
            age = datetime.now(UTC) - datetime.fromisoformat(linked.since)
            assert timedelta(seconds=-1) <= age < timedelta(seconds=BOUND_S)
            server.close()
            for writer in taken:
                writer.close()
            lost = await until(robot.link, is_open=False, error="")
            assert lost.hint
        finally:
            ended.set()
            with suppress(TimeoutError):
                await asyncio.wait_for(relay, BOUND_S)
        assert json.loads((robot.link / STATE).read_text()) == {}, "a relay that ends knows nothing"

    with relay_lock(robot):
        asyncio.run(scenario())
