"""A listening socket with bounds: silent connections, floods and a process without handles."""

from __future__ import annotations

import asyncio
import logging
import os
import resource
import select
import socket
import struct
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import ExitStack, asynccontextmanager, closing, contextmanager, suppress
from dataclasses import replace
from typing import Any

import pytest

from rn_standard.http import listener as listener_module
from rn_standard.http.listener import BoundedListener, ConnectionBounds, other_bounds, stop_bounds
from rn_standard.http.tokens import TokenTable, shown_holder
from roboneuron.server.tool import Holder

pytestmark = pytest.mark.timeout(60)
WIDE = ConnectionBounds(
    silent=100, unproven=100, unproven_of_one=100, new=1000, handle=10_000, handle_known=10_000
)
KNOWN = b"known"


def holder_of(first: bytes) -> str:
    """The letter after `KNOWN`, or no letter; empty for others."""
    return first[: len(KNOWN) + 1].decode() if first.startswith(KNOWN) else ""


class Echo(asyncio.Protocol):
    """Answers what it gets, and counts connections."""

    made = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        type(self).made += 1
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        self.transport.write(data)  # type: ignore[attr-defined]


@asynccontextmanager
async def listening(
    bounds: ConnectionBounds,
) -> AsyncIterator[tuple[BoundedListener, Callable[[], socket.socket]]]:
    """An echo server behind a listener, and a function that connects to it."""
    bound = socket.socket()
    bound.bind(("127.0.0.1", 0))
    Echo.made = 0
    listener = BoundedListener(bound, bounds, holder_of)
    server = await asyncio.get_running_loop().create_server(Echo, sock=listener)
    address = listener.getsockname()
    with ExitStack() as stack:

        def connect() -> socket.socket:
            made = stack.enter_context(closing(socket.create_connection(address, timeout=10)))
            made.setblocking(False)
            return made

        try:
            yield listener, connect
        finally:
            server.close()
            await asyncio.sleep(0)


async def answer(connection: socket.socket, said: bytes = b"x") -> bytes:
    """What comes back; empty when the connection is closed."""
    loop = asyncio.get_running_loop()
    try:
        await loop.sock_sendall(connection, said)
        return await asyncio.wait_for(loop.sock_recv(connection, 100), 10)
    except ConnectionError:
        return b""


async def settle() -> None:
    """The listener has seen everything that has come so far."""
    for _ in range(10):
        await asyncio.sleep(0.001)


def is_closed(connection: socket.socket) -> bool:
    if not select.select([connection], [], [], 0)[0]:
        return False
    try:
        return connection.recv(1) == b""
    except ConnectionError:
        return True


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(test())


def test_a_silent_connection_reaches_no_server() -> None:
    async def test() -> None:
        async with listening(WIDE) as (_, connect):
            silent = connect()
            assert await answer(connect()) == b"x"
            assert Echo.made == 1
            assert await answer(silent) == b"x"

    run(test)


def test_the_oldest_silent_connection_gives_way() -> None:
    async def test() -> None:
        async with listening(replace(WIDE, silent=3)) as (_, connect):
            crowd = [connect() for _ in range(5)]
            await settle()
            assert [is_closed(one) for one in crowd] == [True, True, False, False, False]
            assert await answer(connect()) == b"x"

    run(test)


def test_a_silent_connection_is_closed_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener_module, "SILENT_S", 0.05)

    async def test() -> None:
        async with listening(WIDE) as (_, connect):
            early, late = connect(), connect()
            loop = asyncio.get_running_loop()
            assert await asyncio.wait_for(loop.sock_recv(early, 1), 10) == b""
            assert await asyncio.wait_for(loop.sock_recv(late, 1), 10) == b""

    run(test)


def test_the_oldest_unproven_connection_gives_way_and_a_proven_one_does_not() -> None:
    async def test() -> None:
        async with listening(replace(WIDE, unproven_of_one=3)) as (listener, connect):
            proven = connect()
            assert await answer(proven) == b"x"
            listener.prove(proven.getsockname())
            crowd = []
            for _ in range(5):
                crowd.append(connect())
                assert await answer(crowd[-1]) == b"x"
            await settle()
            assert [is_closed(one) for one in [proven, *crowd]] == [
                False,
                True,
                True,
                False,
                False,
                False,
            ]

    run(test)


def test_connections_that_have_ended_need_no_place() -> None:
    async def test() -> None:
        async with listening(replace(WIDE, unproven_of_one=2)) as (_, connect):
            first = connect()
            assert await answer(first) == b"x"
            for _ in range(5):
                ended = connect()
                assert await answer(ended) == b"x"
                ended.close()
                await settle()
            assert not is_closed(first)

    run(test)


def test_of_many_new_ones_only_those_with_a_right_are_served() -> None:
    async def test() -> None:
        async with listening(replace(WIDE, new=5)) as (_, connect):
            answers = [await answer(connect()) for _ in range(8)]
            assert answers == [b"x"] * 5 + [b""] * 3
            assert await answer(connect(), KNOWN) == KNOWN

    run(test)


def test_one_with_a_right_is_served_before_the_queue_of_others() -> None:
    async def test() -> None:
        bound = socket.create_server(("127.0.0.1", 0), backlog=512)
        with ExitStack() as stack:
            listener = BoundedListener(bound, WIDE, holder_of)
            stack.enter_context(closing(listener))
            for said in [b"x"] * 20 + [KNOWN]:
                made = socket.create_connection(listener.getsockname(), timeout=10)
                stack.enter_context(closing(made))
                made.sendall(said)
            connection, _ = listener.accept()
            stack.enter_context(closing(connection))
            assert connection.recv(100) == KNOWN

    run(test)


@contextmanager
def waiting(bounds: ConnectionBounds, crowd: list[bytes]) -> Iterator[BoundedListener]:
    """A listener and connections that have sent these bytes, each kept open."""
    bound = socket.create_server(("127.0.0.1", 0), backlog=512)
    with ExitStack() as stack:
        listener = BoundedListener(bound, bounds, holder_of)
        stack.enter_context(closing(listener))
        for said in crowd:
            made = socket.create_connection(listener.getsockname(), timeout=10)
            stack.enter_context(closing(made))
            made.sendall(said)
        yield listener


def passed(listener: BoundedListener) -> list[bytes]:
    """What was sent on the connections that one iteration of the event loop passes on."""
    found: list[bytes] = []
    if not select.select([listener], [], [], 0)[0]:
        return found
    with suppress(BlockingIOError):
        while True:
            connection, _ = listener.accept()
            with closing(connection):
                found.append(connection.recv(100))
    return found


@pytest.mark.parametrize(
    ("crowd", "first"),
    [
        ([b"knowna"] * 30 + [b"knownb"], {b"knowna", b"knownb"}),
        ([b"knowna"] * 30 + [b"x"], {b"knowna", b"x"}),
        ([b"x"] * 30 + [b"knownb"], {b"x", b"knownb"}),
    ],
    ids=["holders", "known before unknown", "unknown before known"],
)
def test_an_iteration_passes_on_a_few_of_each_and_the_rest_later(
    crowd: list[bytes], first: set[bytes]
) -> None:
    async def test() -> None:
        with waiting(WIDE, crowd) as listener:
            turn = passed(listener)
            assert set(turn) == first
            assert len(turn) < 6
            rest = list(turn)
            while more := passed(listener):
                assert len(more) < 6
                rest += more
            assert sorted(rest) == sorted(crowd)

    run(test)


def test_whoever_has_most_waiting_connections_gives_handles_to_others() -> None:
    async def test() -> None:
        next_one = os.dup(0)
        os.close(next_one)
        crowd = [b"knowna"] * 30 + [b"knownb"] * 3
        # each connection of this test takes a handle here, and one of the listener
        few = replace(WIDE, handle=next_one + 50, handle_known=next_one + 50)
        with waiting(few, crowd) as listener:
            found: list[bytes] = []
            while more := passed(listener):
                found += more
            assert found.count(b"knownb") == 3
            assert 0 < found.count(b"knowna") < 30

    run(test)


@pytest.mark.parametrize("is_reset", [False, True])
def test_those_that_have_left_cost_no_place_and_hold_nobody_up(is_reset: bool) -> None:
    async def test() -> None:
        async with listening(replace(WIDE, new=5)) as (listener, connect):
            for _ in range(60):
                gone = socket.create_connection(listener.getsockname(), timeout=10)
                if is_reset:
                    gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                gone.close()
            assert await answer(connect()) == b"x"
            assert Echo.made == 1

    run(test)


def test_some_handles_stay_free() -> None:
    async def test() -> None:
        next_one = os.dup(0)
        os.close(next_one)
        # each connection of this test takes two handles: one here, one of the server
        async with listening(replace(WIDE, handle=next_one + 40)) as (_, connect):
            crowd = [connect() for _ in range(60)]
            await settle()
            assert sum(is_closed(one) for one in crowd) >= 40
            assert await answer(connect()) == b""
            assert await answer(connect(), KNOWN) == KNOWN

    run(test)


@contextmanager
def few_handles(left: int) -> Iterator[None]:
    """This process may open only a few more."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    next_one = os.dup(0)
    os.close(next_one)
    resource.setrlimit(resource.RLIMIT_NOFILE, (next_one + left, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_process_without_handles_says_so_once_and_serves_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def test() -> None:
        async with listening(WIDE) as (_, connect):
            # in the queue of the kernel, since nothing was awaited
            crowd = [connect() for _ in range(30)]
            with few_handles(0):
                await settle()
                assert all(is_closed(one) for one in crowd)
            assert await answer(connect()) == b"x"

    with caplog.at_level(logging.ERROR):
        run(test)
    assert [record.levelname for record in caplog.records] == ["ERROR"], caplog.text
    assert "A connection is refused" in caplog.text
    assert "Traceback" not in caplog.text


def test_the_port_of_stops_may_use_handles_that_no_other_port_may() -> None:
    for limit in (256, 1024, 524_288 * 2):
        stops, others = stop_bounds(limit), other_bounds(128, limit)
        assert others.handle <= limit // 2 < stops.handle < stops.handle_known < limit
        assert stops.silent + stops.unproven < stops.handle


def test_a_holder_is_seen_in_the_first_bytes() -> None:
    tokens = TokenTable([("0123456789abcdef", Holder(who="v", role="viewer"))])
    head = (
        b"POST /mcp HTTP/1.1\r\nHost: 127.0.0.1\r\naUTHORIZATION: bearer %s\r\nAccept: */*\r\n\r\n"
    )
    assert shown_holder(tokens, head % b"0123456789abcdef") == "v"
    assert not shown_holder(tokens, head % b"0123456789abcdeX")
    assert not shown_holder(tokens, b"POST /mcp HTTP/1.1\r\n\r\nemergency_stop")
    stop = shown_holder(tokens, head % b"0123456789abcdef" + b"emergency_stop")
    assert stop not in ("", "v")
    assert shown_holder(TokenTable([]), b"POST /mcp HTTP/1.1\r\n\r\nemergency_stop")
    assert not shown_holder(TokenTable([]), b"POST /mcp HTTP/1.1\r\n\r\nget_status")
