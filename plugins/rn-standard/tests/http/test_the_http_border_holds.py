"""What a client can do to an HTTP server by connections, headers, sessions and ids alone."""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import httpx2
import pytest
from wire_server import HELLO, PAGE, TABLE, TOKENS, Server, answer_of, bearer, serving

from rn_standard.http import connections
from rn_standard.http import listener as listener_module
from rn_standard.http.connections import BODY_S, HEADERS_S, ConnectionTable
from rn_standard.http.operator_lease import OperatorLease
from rn_standard.http.options import HttpOptions
from rn_standard.http.origins import HostRules
from rn_standard.http.peers import peer_process
from rn_standard.http.server import listen, make_server
from rn_standard.http.tokens import TokenTable
from rn_testing.waiting import is_closed, wait_until
from roboneuron.server.app import Application
from roboneuron.server.host import Events

pytestmark = pytest.mark.timeout(120)


@pytest.fixture
def server(application: Application) -> Iterator[Server]:
    """With tokens."""
    with serving(application, TABLE) as running:
        yield running


@pytest.fixture
def open_server(application: Application) -> Iterator[Server]:
    """Without."""
    with serving(application, TokenTable([])) as running:
        yield running


_HALF = b"POST /mcp HTTP/1.1\r\nHost: 127.0.0.1\r\n"


@pytest.mark.parametrize(
    "said",
    [b"", _HALF, _HALF + f"Authorization: Bearer {TOKENS['operator']}\r\n".encode()],
    ids=["nothing", "half", "half with a token"],
)
def test_half_open_connections_shut_nobody_out(
    server: Server, monkeypatch: pytest.MonkeyPatch, said: bytes
) -> None:
    monkeypatch.setattr(connections, "HEADERS_S", 90.0)
    monkeypatch.setattr(listener_module, "SILENT_S", 1.0)
    with ExitStack() as stack:
        crowd = []
        for _ in range(600):
            crowd.append(stack.enter_context(server.connect()))
            crowd[-1].sendall(said)
        # a request waits for 30 s at most: what is half open has not timed out by then
        session = server.open_session(**bearer("viewer"))
        assert "result" in server.call(session, 1, "emergency_stop")
        assert is_closed(crowd[0], 30)


@pytest.mark.parametrize("then", [b"", b"X-A: 1\r\n"], ids=["silent", "drip"])
def test_headers_arrive_in_time_or_the_connection_ends(
    server: Server, monkeypatch: pytest.MonkeyPatch, then: bytes
) -> None:
    monkeypatch.setattr(connections, "HEADERS_S", 0.5)
    with server.connect() as connection:
        connection.sendall(b"POST /mcp HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        ended = threading.Event()

        def drip() -> None:
            while then and not ended.wait(0.1):
                try:
                    connection.sendall(then)
                except OSError:
                    return

        dripping = threading.Thread(target=drip)
        dripping.start()
        assert is_closed(connection, 20)
        ended.set()
        dripping.join()


def test_a_body_arrives_in_time_or_the_connection_ends(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "BODY_S", 0.5)
    with server.connect() as connection:
        head = (
            f"POST /mcp HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {TOKENS['viewer']}\r\n"
        )
        connection.sendall(
            head.encode() + b"Content-Type: application/json\r\nContent-Length: 99\r\n\r\n{"
        )
        assert is_closed(connection, 20)
    assert BODY_S > HEADERS_S


def made_connection(address: str, *, is_idle: bool = True) -> Any:
    made = SimpleNamespace(address=address, is_idle=is_idle, dropped=[])
    made.drop = made.dropped.append
    return Hashable(made)


class Hashable:
    """A connection that is only counted."""

    def __init__(self, facts: SimpleNamespace) -> None:
        self.address, self.is_idle, self.dropped, self.drop = (
            facts.address,
            facts.is_idle,
            facts.dropped,
            facts.drop,
        )
        self.client = (facts.address, 1)


def test_a_holder_has_a_share_and_a_stop_is_served_beyond_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, number in {"MOST": 6, "MOST_OF_ONE": 4, "RESERVED": 2}.items():
        monkeypatch.setattr(connections, name, number)
    table = ConnectionTable()
    busy = [made_connection("a", is_idle=False) for _ in range(20)]
    assert [table.prove(c, "viewer") for c in busy[:6]] == [True] * 4 + [False] * 2
    assert table.prove(busy[6], "viewer", is_stop=True)
    # the reserve
    assert [table.prove(c, "operator") for c in busy[7:11]] == [True] * 2 + [False] * 2
    busy[0].is_idle = True
    assert table.prove(busy[11], "viewer")
    assert busy[0].dropped
    table.remove(busy[7])
    assert table.prove(busy[12], "operator")


def test_a_stop_is_taken_from_a_holder_with_too_many_connections(
    server: Server, monkeypatch: pytest.MonkeyPatch, application: Application
) -> None:
    session = server.open_session(**bearer("viewer"))
    monkeypatch.setattr(connections, "MOST_OF_ONE", 0)
    refused = server.post(1, "tools/call", {"name": "get_status", "arguments": {}}, **session)
    assert (refused.status_code, refused.headers["connection"]) == (503, "close")
    assert "result" in server.call(session, 2, "emergency_stop")
    assert application.loop.emergency_stop.is_latched()


def test_sessions_are_shared_out(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    sessions = [server.open_session(**bearer("viewer")) for _ in range(64)]
    refused = server.post(0, "initialize", HELLO, **bearer("viewer"))
    assert (refused.status_code, refused.json()["error"]["code"]) == (503, -32000)
    server.open_session(**bearer("operator"))
    assert httpx2.delete(server.url, headers=sessions[0], timeout=30).status_code == 200
    server.open_session(**bearer("viewer"))


@pytest.mark.parametrize("request_id", [None, True, 1.5, []])
def test_a_request_with_an_impossible_id_is_answered(server: Server, request_id: Any) -> None:
    session = server.open_session(**bearer("viewer"))
    answer = server.post(request_id, "ping", **session)
    assert (answer.status_code, answer.json()["id"], answer.json()["error"]["code"]) == (
        400,
        None,
        -32600,
    )


@pytest.mark.parametrize("again", [7, "7"])
@pytest.mark.parametrize("is_lost", [False, True], ids=["connected", "lost"])
def test_a_repeated_id_is_refused_and_the_first_call_can_be_cancelled(
    server: Server, waiting_tool: Any, again: Any, is_lost: bool
) -> None:
    session = server.open_session(**bearer("operator"))
    body = json.dumps(
        {"jsonrpc": "2.0", "id": 7, "method": "tools/call", "params": {"name": "slow"}}
    ).encode()
    headers = {"Host": "127.0.0.1", "Accept": "application/json, text/event-stream", **session}
    head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    with server.connect() as connection:
        start = (
            f"POST /mcp HTTP/1.1\r\n{head}Content-Type: application/json\r\nContent-Length: "
            f"{len(body)}\r\n\r\n"
        )
        connection.sendall(start.encode() + body)
        assert waiting_tool.begun.wait(30)
        if is_lost:
            connection.close()
        refused = server.post(
            again, "tools/call", {"name": "get_status", "arguments": {}}, **session
        )
        assert (refused.status_code, refused.json()["id"]) == (400, again)
        note = {"jsonrpc": "2.0", "method": "notifications/cancelled", "params": {"requestId": 7}}
        sent = httpx2.post(
            server.url, json=note, headers={**session, "Accept": headers["Accept"]}, timeout=30
        )
        assert sent.status_code == 202
        assert waiting_tool.cancelled.wait(30)
    wait_until(lambda: "error" not in server.call(session, again, "get_status"), 30)


def test_a_page_that_is_allowed_may_read_the_answers(server: Server) -> None:
    asked = {
        "Origin": PAGE,
        "Access-Control-Request-Method": "POST",
        "Access-Control-Request-Headers": "authorization,content-type,mcp-protocol-version",
    }
    preflight = httpx2.options(server.url, headers=asked, timeout=30)
    assert preflight.status_code == 200
    assert preflight.headers["access-control-allow-origin"] == PAGE
    assert "POST" in preflight.headers["access-control-allow-methods"]
    assert "authorization" in preflight.headers["access-control-allow-headers"].lower()
    answer = server.post(0, "initialize", HELLO, Origin=PAGE, **bearer("viewer"))
    assert answer.headers["access-control-allow-origin"] == PAGE
    assert "Mcp-Session-Id" in answer.headers["access-control-expose-headers"]
    unknown = server.post(0, "initialize", HELLO, Origin=PAGE)
    assert (unknown.status_code, unknown.headers["access-control-allow-origin"]) == (401, PAGE)


def test_a_request_with_two_tokens_is_refused(server: Server) -> None:
    """A proxy in front might have judged the other one."""
    tokens = [("Authorization", f"Bearer {TOKENS[role]}") for role in ("admin", "viewer")]
    one = httpx2.delete(server.url, headers=tokens[:1], timeout=30)
    assert one.status_code != 401
    two = httpx2.delete(server.url, headers=tokens, timeout=30)
    assert (two.status_code, two.headers["connection"]) == (401, "close")
    assert "send the header `Authorization: Bearer" in two.json()["error"]["message"]


def test_other_pages_get_nothing(server: Server) -> None:
    for origin in ("https://panel.lan.evil", "https://panel.lan:444", "null"):
        headers = {"Origin": origin, "Access-Control-Request-Method": "POST"}
        answer = httpx2.options(server.url, headers=headers, timeout=30)
        assert (answer.status_code, "access-control-allow-origin" in answer.headers) == (403, False)
        assert server.post(1, "ping", Origin=origin, **bearer("admin")).status_code == 403


def test_changes_of_the_tools_are_announced(server: Server) -> None:
    answer = answer_of(server.post(0, "initialize", HELLO, **bearer("viewer")))
    assert answer["result"]["capabilities"]["tools"]["listChanged"] is True


def test_the_stream_of_a_call_says_when_to_connect_again(server: Server) -> None:
    session = server.open_session(**bearer("viewer"))
    answer = server.post(1, "tools/list", {}, **session)
    assert answer.headers["content-type"].startswith("text/event-stream")
    assert [line for line in answer.text.splitlines() if line][:2] == [
        "retry: 1000",
        "event: message",
    ]
    assert answer.text.count("retry:") == 1


def test_only_one_of_two_clients_without_a_token_acts(open_server: Server) -> None:
    first, second = open_server.open_session(), open_server.open_session()
    assert "operates the robot" not in json.dumps(open_server.call(first, 1, "stop_perception"))
    assert "result" in open_server.call(first, 2, "set_instruction")
    refused = open_server.call(second, 1, "set_instruction")["result"]
    assert "operates the robot" in refused["content"][0]["text"]
    assert not open_server.call(second, 2, "take_over")["result"].get("isError")
    assert "operates the robot" in json.dumps(open_server.call(first, 3, "set_instruction"))
    assert httpx2.delete(open_server.url, headers=second, timeout=30).status_code == 200
    assert "operates the robot" not in json.dumps(open_server.call(first, 4, "set_instruction"))


def test_clients_without_a_session_are_told_apart(open_server: Server) -> None:
    import anyio
    from mcp import Client, types

    async def act(name: str) -> str:
        async with Client(
            open_server.url, client_info=types.Implementation(name=name, version="1")
        ) as client:
            return str((await client.call_tool("set_instruction", {"instruction": "wave"})).content)

    assert "operates the robot" not in anyio.run(act, "ann")
    assert "operates the robot" not in anyio.run(act, "ann")
    assert "(ann)' operates the robot" in anyio.run(act, "bob")


def test_an_operator_with_an_open_stream_is_not_silent(application: Application) -> None:
    now_s, lapses = [100.0], list[str]()
    lease = OperatorLease(60.0, application.host.audit, lapses.append, clock=lambda: now_s[0])
    events = Events()
    events.presence.listen(lease.note_presence)
    with serving(application, TABLE, events) as server:
        session = server.open_session(**bearer("operator"))
        lease.take_over("operator", "operator")
        stream = {**session, "Accept": "text/event-stream"}
        with (
            httpx2.Client(timeout=30) as http,
            http.stream("GET", server.url, headers=stream) as answer,
        ):
            assert answer.status_code == 200
            now_s[0] += 3600.0
            lease.look()
            assert lapses == []
        deadline_s = time.monotonic() + 30.0
        while not lapses:  # the loss of the connection is noticed, and the time from then on counts
            assert time.monotonic() < deadline_s
            now_s[0] += 1.0
            lease.look()
            time.sleep(0.01)
    assert "'operator' has lapsed: silent for 6" in lapses[0]


def test_a_client_without_a_session_is_known_by_its_process() -> None:
    import os

    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as connection:
            assert peer_process(connection.getsockname()[1], port) == os.getpid()
        assert peer_process(1, port) is None


def test_where_it_serves_is_said_once_it_does(
    application: Application, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    options = HttpOptions(port=0)
    with listen(options, TABLE) as listener:
        server = make_server(
            application.server, options, HostRules(options), TABLE, application.events
        )
        assert "serves MCP on" not in caplog.text
        seen: list[bool] = []

        class Look(logging.Handler):
            def emit(self, record: logging.LogRecord) -> None:
                if "serves MCP on" in record.getMessage():
                    with socket.socket() as probe:
                        seen.append(probe.connect_ex(listener.getsockname()) == 0)
                    server.should_exit = True

        handler = Look()
        logging.getLogger("rn_standard.http.server").addHandler(handler)
        try:
            asyncio.run(server.serve(sockets=[listener]))
        finally:
            logging.getLogger("rn_standard.http.server").removeHandler(handler)
    assert seen == [True]
