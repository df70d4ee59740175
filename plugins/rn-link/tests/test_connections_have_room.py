"""Connections to machines of the link, and no others, get twice the room that Fast DDS fills."""

from __future__ import annotations

import socket
from contextlib import closing

from rn_link.connections import ConnectionWatch
from rn_testing.waiting import wait_until

ASKED = 50_000


def room(connection: socket.socket) -> int:
    return connection.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)


def connected(server: socket.socket) -> socket.socket:
    """As Fast DDS makes one: with a buffer of its own choice."""
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, ASKED)
    made.connect(server.getsockname())
    return made


def test_only_connections_to_these_addresses_get_room_and_only_once() -> None:
    with (
        closing(socket.create_server(("127.0.0.2", 0))) as near,
        closing(socket.create_server(("127.0.0.3", 0))) as other,
        closing(connected(near)) as first,
        closing(connected(other)) as foreign,
    ):
        assert room(first) == 2 * ASKED
        watch = ConnectionWatch(frozenset({"127.0.0.2"}))
        watch.start()
        try:
            wait_until(lambda: room(first) > 2 * ASKED, 10.0, "room")
            with closing(connected(near)) as later:
                wait_until(lambda: room(later) > 2 * ASKED, 10.0, "room for another one")
            assert room(first) == 4 * ASKED
            assert room(foreign) == 2 * ASKED
        finally:
            watch.close()
