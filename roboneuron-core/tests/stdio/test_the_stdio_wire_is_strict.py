"""What is no message on stdin is answered, ids are told apart, and a flood holds nothing up."""

from __future__ import annotations

import asyncio
import json
import os
import threading
from collections.abc import Awaitable, Callable
from typing import Any

import anyio
import pytest

from roboneuron.server.app import Application
from roboneuron.stdio.message_stream import MAX_LINE_BYTES, LineWriter, MessageStream

Work = Callable[["Wire"], Awaitable[None]]
HELLO = {
    "protocolVersion": "2025-06-18",
    "capabilities": {},
    "clientInfo": {"name": "wire", "version": "1"},
}


class Wire:
    """The client's ends of two pipes."""

    def __init__(self, to_server: int, from_server: int) -> None:
        self._to_server = to_server
        self._lines: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._read, args=(loop, from_server), daemon=True)
        self._thread.start()

    def _read(self, loop: asyncio.AbstractEventLoop, descriptor: int) -> None:
        with os.fdopen(descriptor, "rb") as file:
            for line in file:
                loop.call_soon_threadsafe(self._lines.put_nowait, json.loads(line))

    async def raw(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[await asyncio.to_thread(os.write, self._to_server, view[:65536]) :]

    async def send(self, request_id: Any, method: str, **params: Any) -> None:
        message = {"jsonrpc": "2.0", "id": request_id, "method": method, "params": params}
        await self.raw(json.dumps(message).encode() + b"\n")

    async def notify(self, method: str, **params: Any) -> None:
        await self.raw(
            json.dumps({"jsonrpc": "2.0", "method": method, "params": params}).encode() + b"\n"
        )

    async def answer(self, wanted: Any = ...) -> dict[str, Any]:
        """The next message, or the next with this id."""
        with anyio.fail_after(60):
            while True:
                message = await self._lines.get()
                if wanted is ... or ("id" in message and message["id"] == wanted):
                    return message

    def leave(self) -> None:
        os.close(self._to_server)


@pytest.fixture
def serve(application: Application) -> Callable[[Work], None]:
    """Serve one client of two pipes."""

    async def scenario(work: Work) -> None:
        server_in, client_out = os.pipe()
        client_in, server_out = os.pipe()
        lines = LineWriter(server_out)
        lines.start()
        reader = MessageStream(server_in, lines.write, 200)
        reader.start()
        server = application.server
        async with anyio.create_task_group() as group:
            options = server.create_initialization_options()
            group.start_soon(server.run, reader, reader, options)  # type: ignore[arg-type]
            wire = Wire(client_out, client_in)
            await wire.send(0, "initialize", **HELLO)
            assert "tools" in (await wire.answer(0))["result"]["capabilities"]
            await wire.notify("notifications/initialized")
            try:
                await work(wire)
            finally:
                wire.leave()
                group.cancel_scope.cancel()
        lines.close()
        os.close(server_out)

    return lambda work: anyio.run(scenario, work)


async def still_works(wire: Wire) -> None:
    await wire.send("last", "ping")
    assert (await wire.answer("last"))["result"] == {}


@pytest.mark.parametrize("request_id", [None, True, 1.5, 2.0, [], {}])
def test_a_request_with_an_impossible_id_is_answered(
    serve: Callable[[Work], None], request_id: Any
) -> None:
    async def work(wire: Wire) -> None:
        await wire.send(request_id, "ping")
        assert (await wire.answer(None))["error"]["code"] == -32600
        await still_works(wire)

    serve(work)


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b'{"jsonrpc": "2.0", "id": 5, "method": "ping\xff"}', -32700),
        (
            b'{"jsonrpc": "2.0", "id": 5, "method": "tools/call", "params": {"name": '
            b'"\xed\xa0\x80"}}',
            -32700,
        ),
        (b"x" * (MAX_LINE_BYTES + 1), -32600),
        (b"no json", -32700),
        (b"[" * 100_000, -32700),
        (b'[{"jsonrpc": "2.0", "id": 5, "method": "ping"}]', -32600),
        (b"7", -32600),
    ],
    ids=["not UTF-8", "surrogate", "too long", "not JSON", "deep", "batch", "number"],
)
def test_a_line_that_is_no_message_is_answered(
    serve: Callable[[Work], None], line: bytes, code: int
) -> None:
    async def work(wire: Wire) -> None:
        await wire.raw(line + b"\n")
        answer = await wire.answer()
        assert (answer["id"], answer["error"]["code"]) == (None, code)
        await still_works(wire)

    serve(work)


@pytest.mark.parametrize("again", [7, "7"])
def test_a_repeated_id_is_refused_and_the_first_call_can_be_cancelled(
    waiting_tool: Any, serve: Callable[[Work], None], again: Any
) -> None:
    async def work(wire: Wire) -> None:
        await wire.send(7, "tools/call", name="slow", arguments={})
        await wire.send(again, "tools/call", name="get_status", arguments={})
        answer = await wire.answer()
        assert (answer["id"], answer["error"]["code"]) == (again, -32600)
        await wire.notify("notifications/cancelled", requestId=7)
        assert await asyncio.to_thread(waiting_tool.cancelled.wait, 30)
        await still_works(wire)
        await wire.send(7, "ping")  # a cancelled call has no answer, and its id is free
        assert (await wire.answer(7))["result"] == {}

    serve(work)


def test_an_id_is_free_once_it_was_answered(serve: Callable[[Work], None]) -> None:
    async def work(wire: Wire) -> None:
        for _ in range(3):
            await wire.send(3, "ping")
            assert (await wire.answer())["id"] == 3

    serve(work)


def test_a_flood_of_pings_lets_everything_else_pass() -> None:
    """Of what waits, the stop is taken first, then the call; of the pings, sixteen at once."""
    reader = MessageStream(0, lambda text: None, 1)
    for request_id in range(1000, 1900):
        reader._take(b'{"jsonrpc": "2.0", "id": %d, "method": "ping"}' % request_id)
    for request_id, tool in ((1, "get_status"), (2, "emergency_stop")):
        line = {"jsonrpc": "2.0", "id": request_id, "method": "tools/call"}
        params = {"name": tool, "arguments": {}}
        reader._take(json.dumps({**line, "params": params}).encode())
    taken = [message.id for message in iter(reader._next, None)]
    assert taken == [2, 1, *range(1000, 1016)]


def test_a_flood_of_pings_leaves_nothing_unanswered(serve: Callable[[Work], None]) -> None:
    async def work(wire: Wire) -> None:
        flood = b"".join(
            b'{"jsonrpc": "2.0", "id": %d, "method": "ping"}\n' % i for i in range(1000, 31_000)
        )
        call = {"jsonrpc": "2.0", "id": 1, "method": "tools/call"}
        params = {"name": "get_status", "arguments": {}}
        await wire.raw(flood + json.dumps({**call, "params": params}).encode() + b"\n")
        answers = [await wire.answer() for _ in range(30_001)]
        assert {answer["id"] for answer in answers} == {1, *range(1000, 31_000)}
        refusals = [answer["error"]["code"] for answer in answers if "error" in answer]
        assert set(refusals) <= {-32000}, "only as one of too many"
        await still_works(wire)

    serve(work)


def test_what_waits_can_be_cancelled() -> None:
    reader = MessageStream(0, lambda text: None, 1)
    for request_id in (1, 2):
        line = {
            "jsonrpc": "2.0",
            "id": request_id,
            "method": "tools/call",
            "params": {"name": "slow"},
        }
        reader._take(json.dumps(line).encode())
    assert reader._next().id == 1
    assert reader._next() is None  # one is at work
    cancel = {"jsonrpc": "2.0", "method": "notifications/cancelled", "params": {"requestId": 2}}
    reader._take(json.dumps(cancel).encode())
    assert reader._next().method == "notifications/cancelled"
    anyio.run(reader._settle, 1)
    assert reader._next() is None


def test_too_many_waiting_requests_are_refused_and_a_stop_is_not() -> None:
    answers: list[dict[str, Any]] = []
    reader = MessageStream(0, lambda text: answers.append(json.loads(text)), 1)
    for request_id in range(1002):
        reader._take(b'{"jsonrpc": "2.0", "id": %d, "method": "tools/list"}' % request_id)
    assert [(a["id"], a["error"]["code"]) for a in answers] == [(1000, -32000), (1001, -32000)]
    stop = {
        "jsonrpc": "2.0",
        "id": 9999,
        "method": "tools/call",
        "params": {"name": "emergency_stop"},
    }
    reader._take(json.dumps(stop).encode())
    assert reader._next().id == 9999
