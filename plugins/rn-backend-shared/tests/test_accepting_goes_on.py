"""Errors of accept(2): only a closed listener ends a server's loop."""

from __future__ import annotations

import errno
import socket
import threading
from collections.abc import Iterator

import pytest
from policy_servers import PASSING, fail_accepts

from rn_backend_shared import listening
from rn_backend_shared.listening import connections

HANDLES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


@pytest.fixture
def listener(monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """A listener without pauses."""
    monkeypatch.setattr(listening, "_PAUSE_S", 0.0)
    monkeypatch.setattr(listening, "_NO_HANDLES_S", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as made:
        yield made


@pytest.mark.parametrize("number", [*PASSING, *HANDLES])
def test_the_next_connection_is_accepted_after_an_error(
    listener: socket.socket, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    fail_accepts(monkeypatch, number)
    room: list[int] = []
    with socket.create_connection(listener.getsockname()):
        accepting = connections(listener, threading.Event(), lambda: room.append(number))
        connected, address = next(accepting)
    connected.close()
    assert address == "127.0.0.1"
    assert room == ([number] if number in HANDLES else [])


@pytest.mark.parametrize("number", [errno.EBADF, errno.EINVAL])
def test_a_closed_listener_ends_it(
    listener: socket.socket, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    fail_accepts(monkeypatch, number)
    assert list(connections(listener, threading.Event(), int)) == []


def test_the_end_of_the_server_ends_it(
    listener: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = threading.Event()
    fail_accepts(monkeypatch, *HANDLES)
    assert list(connections(listener, ended, ended.set)) == []
