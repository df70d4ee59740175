"""Connections to the machines of the link, and no others, are given up after a second of silence."""

from __future__ import annotations

import socket
from contextlib import closing

from rn_link.connections import GIVEN_UP_S, bound_connections


def timeout_ms(connection: socket.socket) -> int:
    return connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)


def test_only_connections_to_these_addresses_are_bounded() -> None:
    with (
        closing(socket.create_server(("127.0.0.2", 0))) as near,
        closing(socket.create_server(("127.0.0.3", 0))) as other,
        closing(socket.create_connection(near.getsockname())) as bounded,
        closing(socket.create_connection(other.getsockname())) as free,
    ):
        assert bound_connections(frozenset({"127.0.0.2"})) == 1
        assert timeout_ms(bounded) == GIVEN_UP_S * 1e3
        assert timeout_ms(free) == 0
        assert timeout_ms(near) == 0


def test_a_connection_that_is_being_made_is_bounded_too() -> None:
    with (
        closing(socket.create_server(("127.0.0.2", 0), backlog=0)) as full,
        closing(socket.create_connection(full.getsockname())),
        closing(socket.socket()) as waiting,
    ):
        waiting.setblocking(False)
        waiting.connect_ex(full.getsockname())
        assert bound_connections(frozenset({"127.0.0.2"})) == 2
        assert timeout_ms(waiting) == GIVEN_UP_S * 1e3


def test_without_connections_there_is_nothing_to_do() -> None:
    assert bound_connections(frozenset({"127.0.0.9"})) == 0
