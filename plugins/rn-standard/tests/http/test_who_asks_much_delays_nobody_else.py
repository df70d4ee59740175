"""Requests of one holder begin in turn with those of others."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from contextlib import ExitStack
from typing import Any

import pytest
from mcp_types import CLIENT_CAPABILITIES_META_KEY, PROTOCOL_VERSION_META_KEY
from wire_server import TABLE, bearer, serving

from rn_standard.http.fairness import RequestShares
from rn_testing.waiting import wait_until
from roboneuron.server.app import Application
from roboneuron.server.host import Events

pytestmark = pytest.mark.timeout(120)
NEWEST = "2026-07-28"


def request_of(role: str, method: str, params: Any) -> bytes:
    """A whole request of a client without a session."""
    params = {
        **params,
        "_meta": {PROTOCOL_VERSION_META_KEY: NEWEST, CLIENT_CAPABILITIES_META_KEY: {}},
    }
    body = json.dumps({"jsonrpc": "2.0", "id": 0, "method": method, "params": params})
    lines = {
        "Host": "127.0.0.1",
        **bearer(role),
        "Accept": "application/json, text/event-stream",
        "Content-Type": "application/json",
        "Content-Length": str(len(body)),
        "MCP-Protocol-Version": NEWEST,
        "Mcp-Method": method,
        "Mcp-Name": str(params.get("name", "")),
    }
    head = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    return f"POST /mcp HTTP/1.1\r\n{head}\r\n{body}".encode()


@pytest.mark.parametrize("are_open", [False, True], ids=["new connections", "open connections"])
@pytest.mark.parametrize("tool", ["emergency_stop", "get_status"])
def test_who_asks_once_waits_for_a_few_requests_of_who_asks_a_hundred_times(
    application: Application, are_open: bool, tool: str
) -> None:
    """All requests wait in front of the event loop when it goes on, the single one as the last."""
    begun: list[str] = []
    blocked, sent = threading.Event(), threading.Event()
    events = Events()

    def note(who: str, change: int) -> None:
        if change > 0:
            begun.append(who)
        if who == "admin":
            blocked.set()
            sent.wait(60)

    events.presence.listen(note)
    call = {"name": "get_status", "arguments": {}}
    with serving(application, TABLE, events) as server, ExitStack() as stack:

        def connect() -> socket.socket:
            return stack.enter_context(server.connect())

        requests = [request_of("viewer", "tools/call", call)] * 100
        requests.append(request_of("operator", "tools/call", {**call, "name": tool}))
        opened = []
        for role in (["viewer"] * 100 + ["operator"]) * are_open:
            opened.append(connect())
            opened[-1].sendall(request_of(role, "tools/list", {}))
            assert opened[-1].recv(100).startswith(b"HTTP/1.1 200")
        begun.clear()
        connect().sendall(request_of("admin", "tools/call", call))
        assert blocked.wait(60)
        for number, request in enumerate(requests):
            (opened[number] if opened else connect()).sendall(request)
        sent.set()
        wait_until(lambda: "operator" in begun, 60)
    assert begun.index("operator") < 20, begun


def test_requests_of_one_holder_begin_two_at_a_time_and_each_in_its_turn() -> None:
    async def test() -> None:
        turns = RequestShares()
        first = [turns.at_once("a"), turns.at_once("a")]
        assert turns.at_once("a") is None
        waiting = {name: asyncio.ensure_future(turns.wait(name[0])) for name in ("a1", "a2", "a3")}
        await asyncio.sleep(0)
        other = turns.at_once("b")
        assert other is not None
        waiting["a1"].cancel()
        assert first[0] is not None
        first[0].end()
        first[0].end()
        await asyncio.wait([waiting["a2"]])
        assert not waiting["a3"].done()
        # what takes longer counts no more
        assert (await asyncio.wait_for(waiting["a3"], 20)) is not None
        waiting["a2"].result().end()
        other.end()

    asyncio.run(test())
