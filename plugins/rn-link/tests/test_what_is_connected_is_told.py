"""For every paired machine `link show` and `doctor` report whether it is connected, according to
the relay.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import ssl
from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from link_members import BOUND_S, admit_at_a_port, answering, relaying
from link_members import robot as robot
from link_pairs import Place, admit, pair

from rn_link.command import LinkCommand
from rn_link.machine import Machine as Paired
from rn_link.machine import Peer
from rn_link.state import (
    LOCK,
    STATE,
    PeerConnection,
    StateFile,
    connected_now,
    hint_for,
    read_connections,
)
from rn_testing.waiting import wait_until

HUB = Paired(name="robot", role="hub", peers={"gpu": Peer("10.0.0.2", 7411)})


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


def test_every_machine_is_told_with_its_time_or_its_error(
    robot: Place, gpu: Place, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not LinkCommand().findings(), "no peer"
    pair(robot, gpu)
    for name in ("desk", "lab"):
        admit(robot.link, robot.link.parent / name, name, Peer("10.0.0.9"))
    state = StateFile(robot.link)
    linked = connected_now()
    state.set("gpu", linked)
    state.set("desk", PeerConnection(error="no answer", hint="Is desk on?"))
    assert read_connections(robot.link) is None, "of a killed relay"
    assert all("no relay is running" in told for _, told, _ in LinkCommand().findings())
    with relay_lock(robot):
        found = LinkCommand().findings()
        parser, command = ArgumentParser(), LinkCommand()
        command.configure(parser)
        assert command.run(parser.parse_args(["show"])) == 0
    place = "The machine {} ({}, TCP 7411) is {}."
    assert found == [
        (True, place.format("gpu", "127.0.0.1", f"connected since {linked.since}"), ""),
        (False, place.format("desk", "10.0.0.9", "NOT connected: no answer"), "Is desk on?"),
        (
            False,
            place.format("lab", "10.0.0.9", "NOT connected: it is being connected"),
            "Look again in a moment.",
        ),
    ]
    lines = capsys.readouterr().out.splitlines()[1:]
    assert lines == [f"{told} {hint}".rstrip() for _, told, hint in found]
    state.forget("gpu")
    assert "gpu" not in json.loads((robot.link / STATE).read_text())


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


def wait_for(place: Place, *, is_open: bool, hint: str = "") -> PeerConnection:
    """The connection to the member as read from the file, once it is as expected."""

    def found() -> PeerConnection:
        return (read_connections(place.link) or {}).get("gpu", PeerConnection())

    wait_until(
        lambda: found().is_open is is_open and hint in found().hint, BOUND_S, f"{is_open}, {hint}"
    )
    return found()


def test_the_relay_tells_what_becomes_of_a_connection(robot: Place, tmp_path: Path) -> None:
    port = admit_at_a_port(robot, tmp_path / "gpu", "gpu")
    with relay_lock(robot):
        with relaying(robot):
            wait_for(robot, is_open=False, hint="Start RoboNeuron on gpu")
            with answering(tmp_path / "gpu", port):
                linked = wait_for(robot, is_open=True)
                age = datetime.now(UTC) - datetime.fromisoformat(linked.since)
                assert timedelta(seconds=-1) <= age < timedelta(seconds=BOUND_S)
            wait_for(robot, is_open=False, hint="gpu")
        assert read_connections(robot.link) == {}, "a relay that ends knows nothing"
