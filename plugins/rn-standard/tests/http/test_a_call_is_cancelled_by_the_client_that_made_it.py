"""Which client may cancel which call by a POST of its own, in each protocol, and the answer."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from mcp_types import CLIENT_CAPABILITIES_META_KEY, PROTOCOL_VERSION_META_KEY
from mcp_types.version import HANDSHAKE_PROTOCOL_VERSIONS, KNOWN_PROTOCOL_VERSIONS
from wire_server import TABLE, Server, bearer, serving

from rn_standard.http.tokens import TokenTable
from roboneuron.server.app import Application

pytestmark = pytest.mark.timeout(120)
NEWEST = "2026-07-28"
META = {PROTOCOL_VERSION_META_KEY: NEWEST, CLIENT_CAPABILITIES_META_KEY: {}}
ACCEPT = {"Accept": "application/json, text/event-stream"}


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


def client_of(server: Server, version: str, **headers: str) -> dict[str, str]:
    """Headers of a client's requests after its introduction."""
    if version in HANDSHAKE_PROTOCOL_VERSIONS:
        session = server.open_session(**headers)
        return {**session, "mcp-protocol-version": version}
    return {"mcp-protocol-version": version, **headers}


def begin(connection: socket.socket, client: dict[str, str], request_id: Any) -> None:
    """Call the tool `slow` on a connection, and leave the answer unread."""
    params: dict[str, Any] = {"name": "slow", "arguments": {}}
    headers = {"Host": "127.0.0.1", **ACCEPT, **client}
    if client["mcp-protocol-version"] == NEWEST:
        params["_meta"] = META
        headers |= {"Mcp-Method": "tools/call", "Mcp-Name": "slow"}
    message = {"jsonrpc": "2.0", "id": request_id, "method": "tools/call", "params": params}
    body = json.dumps(message).encode()
    headers |= {"Content-Type": "application/json", "Content-Length": str(len(body))}
    head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    connection.sendall(f"POST /mcp HTTP/1.1\r\n{head}\r\n".encode() + body)


def cancel(server: Server, client: dict[str, str], request_id: Any) -> tuple[int, Any]:
    """Status and error code of a `notifications/cancelled`."""
    answer = server.notify("notifications/cancelled", {"requestId": request_id}, **client)
    return answer.status_code, answer.json()["error"]["code"] if answer.text else None


def read_to_the_end(connection: socket.socket) -> str:
    """The whole answer of a call; fails the test after a while."""
    connection.settimeout(30)
    found = b""
    while b"-32800" not in found and (data := connection.recv(65536)):
        found += data
    return found.decode()


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("request_id", [7, "7", "seven", -1], ids=repr)
@pytest.mark.parametrize("version", KNOWN_PROTOCOL_VERSIONS)
def test_its_client_cancels_a_call(
    server: Server, waiting_tool: Any, version: str, request_id: Any
) -> None:
    client = client_of(server, version, **bearer("operator"))
    with server.connect() as connection:
        begin(connection, client, request_id)
        assert waiting_tool.begun.wait(30)
        assert cancel(server, client, request_id) == (202, None)
        assert waiting_tool.cancelled.wait(30)
        assert "Request cancelled" in read_to_the_end(connection)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize(
    ("called", "cancelled"), [(7, "7"), ("7", 7)], ids=["number-text", "text-number"]
)
@pytest.mark.parametrize("version", KNOWN_PROTOCOL_VERSIONS)
def test_a_client_may_write_a_numbers_id_as_text(
    server: Server, waiting_tool: Any, version: str, called: Any, cancelled: Any
) -> None:
    client = client_of(server, version, **bearer("operator"))
    with server.connect() as connection:
        begin(connection, client, called)
        assert waiting_tool.begun.wait(30)
        assert cancel(server, client, cancelled) == (202, None)
        assert waiting_tool.cancelled.wait(30)


@pytest.mark.parametrize("other", ["admin", "viewer"])
@pytest.mark.parametrize("version", KNOWN_PROTOCOL_VERSIONS)
def test_a_client_of_another_token_cancels_nothing(
    server: Server, waiting_tool: Any, version: str, other: str
) -> None:
    client = client_of(server, version, **bearer("operator"))
    foreign = client_of(server, version, **bearer(other))
    with server.connect() as connection:
        begin(connection, client, 7)
        assert waiting_tool.begun.wait(30)
        if version == NEWEST:
            assert cancel(server, foreign, 7) == (400, -32602)
        else:  # ids belong to a session: there, the foreign client has no such call
            assert cancel(server, foreign, 7) == (202, None)
            assert cancel(server, {**client, **bearer(other)}, 7)[0] == 404
        assert cancel(server, client, 7) == (202, None)
        assert waiting_tool.cancelled.wait(30)
        assert waiting_tool.ends == 1


def test_a_session_of_the_same_token_cancels_nothing(server: Server, waiting_tool: Any) -> None:
    client, other = (client_of(server, "2025-11-25", **bearer("operator")) for _ in range(2))
    with server.connect() as connection:
        begin(connection, client, 7)
        assert waiting_tool.begun.wait(30)
        assert cancel(server, other, 7) == (202, None)
        newest = client_of(server, NEWEST, **bearer("operator"))
        assert cancel(server, newest, 7) == (400, -32602)
        assert not waiting_tool.cancelled.wait(0.2)
        assert cancel(server, client, 7) == (202, None)
        assert waiting_tool.cancelled.wait(30)


OTHER_PROCESS = """
import json, sys, urllib.error, urllib.request
url, headers = sys.argv[1], json.loads(sys.argv[2])
note = {"jsonrpc": "2.0", "method": "notifications/cancelled", "params": {"requestId": 7}}
asked = urllib.request.Request(url, json.dumps(note).encode(), headers)
try:
    print(urllib.request.urlopen(asked, timeout=30).status)
except urllib.error.HTTPError as error:
    print(error.code)
"""


@pytest.mark.parametrize("has_tokens", [True, False], ids=["same-token", "no-tokens"])
def test_another_process_cancels_nothing(
    request: pytest.FixtureRequest, waiting_tool: Any, has_tokens: bool
) -> None:
    server = request.getfixturevalue("server" if has_tokens else "open_server")
    client = client_of(server, NEWEST, **(bearer("operator") if has_tokens else {}))
    headers = json.dumps({**ACCEPT, **client, "Content-Type": "application/json"})
    with server.connect() as connection:
        begin(connection, client, 7)
        assert waiting_tool.begun.wait(30)
        other = subprocess.run(
            [sys.executable, "-c", OTHER_PROCESS, server.url, headers],
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
        assert other.stdout.strip() == "400"
        assert not waiting_tool.cancelled.is_set()
        assert cancel(server, client, 7) == (202, None)
        assert waiting_tool.cancelled.wait(30)


def test_an_id_of_no_call_is_told(server: Server, waiting_tool: Any) -> None:
    client = client_of(server, NEWEST, **bearer("operator"))
    with server.connect() as connection:
        begin(connection, client, 7)
        assert waiting_tool.begun.wait(30)
        for wrong in (8, "eight", None, True, 7.5, [], {}):
            assert cancel(server, client, wrong) == (400, -32602), wrong
        assert not waiting_tool.cancelled.is_set()
        assert cancel(server, client, 7) == (202, None)
        assert waiting_tool.cancelled.wait(30)


def test_an_id_of_two_calls_is_told(server: Server, waiting_tool: Any) -> None:
    client = client_of(server, NEWEST, **bearer("operator"))
    with server.connect() as first, server.connect() as second:
        begin(first, client, 7)
        assert waiting_tool.begun.wait(30)
        waiting_tool.begun.clear()
        begin(second, client, 7)
        assert waiting_tool.begun.wait(30)
        assert cancel(server, client, 7) == (400, -32602)
        assert not waiting_tool.cancelled.is_set()
        second.close()
        assert waiting_tool.cancelled.wait(30)


def test_a_cancellation_that_comes_late_is_accepted(server: Server) -> None:
    client = client_of(server, NEWEST, **bearer("operator"))
    params = {"name": "get_status", "arguments": {}, "_meta": META}
    named = {"Mcp-Method": "tools/call", "Mcp-Name": "get_status"}
    assert server.post(7, "tools/call", params, **client, **named).status_code == 200
    assert cancel(server, client, 7) == (202, None)
    assert cancel(server, client_of(server, NEWEST, **bearer("admin")), 7) == (400, -32602)


def test_a_cancellation_without_the_protocols_header_reaches_its_call(
    server: Server, waiting_tool: Any
) -> None:
    client = client_of(server, NEWEST, **bearer("operator"))
    with server.connect() as connection:
        begin(connection, client, 7)
        assert waiting_tool.begun.wait(30)
        assert cancel(server, bearer("operator"), 7) == (202, None)
        assert waiting_tool.cancelled.wait(30)


VERSIONS = [
    ("2025-11-25", NEWEST, -32020),
    ("2025-06-18", NEWEST, -32020),
    (None, NEWEST, -32020),
    (NEWEST, "2025-11-25", -32020),
    ("2027-01-01", NEWEST, -32020),
    (NEWEST, "2027-01-01", -32020),
    ("2027-01-01", "2027-01-01", -32022),
    (NEWEST, NEWEST, None),
]
"""Header, body, and the code of the error. Source: protocol 2026-07-28, Streamable HTTP."""


@pytest.mark.parametrize("has_session", [False, True], ids=["no-session", "session"])
def test_header_and_body_name_the_same_protocol(server: Server, has_session: bool) -> None:
    for header, body, code in VERSIONS:
        headers = {**bearer("viewer"), "Mcp-Method": "tools/list"}
        if has_session:
            opened = server.open_session(**bearer("viewer"))
            headers["mcp-session-id"] = opened["mcp-session-id"]
        if header is not None:
            headers["mcp-protocol-version"] = header
        meta = {**META, PROTOCOL_VERSION_META_KEY: body}
        answer = server.post("a", "tools/list", {"_meta": meta}, **headers)
        error = answer.json().get("error", {})
        found = (answer.status_code, answer.json()["id"], error.get("code"))
        assert found == (200 if code is None else 400, "a", code), (header, body)
        if code == -32020:
            assert body in error["message"]
            assert header is None or header in error["message"]


def test_a_session_may_still_negotiate_another_protocol(server: Server) -> None:
    headers = {**bearer("viewer"), "mcp-protocol-version": "2025-11-25"}
    assert server.open_session(**headers)
