"""An HTTP server in the process of the test, and what a client does to it by hand."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx2

from rn_standard.http.options import HttpOptions
from rn_standard.http.origins import HostRules
from rn_standard.http.server import listen, make_server
from rn_standard.http.tokens import TokenTable
from rn_testing.waiting import wait_until
from roboneuron.server.app import Application
from roboneuron.server.host import Events
from roboneuron.server.tool import Holder

TOKENS = {role: f"{role}-token-of-this-test" for role in ("viewer", "operator", "admin")}
TABLE = TokenTable([(token, Holder(who=role, role=role)) for role, token in TOKENS.items()])
HELLO = {
    "protocolVersion": "2025-06-18",
    "capabilities": {},
    "clientInfo": {"name": "wire", "version": "1"},
}
PAGE = "https://panel.lan"


class Server:
    """A server in this process, on a free port of loopback."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.url = f"http://127.0.0.1:{port}/mcp"

    def post(
        self, request_id: Any, method: str, params: Any = None, **headers: str
    ) -> httpx2.Response:
        body = {"jsonrpc": "2.0", "id": request_id, "method": method, "params": params or {}}
        sent = {"Accept": "application/json, text/event-stream", **headers}
        # verify: every call makes a client, and to load the certificates took most of its time
        return httpx2.post(self.url, json=body, headers=sent, timeout=30, verify=False)

    def notify(self, method: str, params: Any, **headers: str) -> httpx2.Response:
        body = {"jsonrpc": "2.0", "method": method, "params": params}
        sent = {"Accept": "application/json, text/event-stream", **headers}
        return httpx2.post(self.url, json=body, headers=sent, timeout=30, verify=False)

    def open_session(self, **headers: str) -> dict[str, str]:
        """Headers of a session that is open."""
        answer = self.post(0, "initialize", HELLO, **headers)
        assert answer.status_code == 200, answer.text
        return {
            "mcp-session-id": answer.headers["mcp-session-id"],
            "mcp-protocol-version": "2025-06-18",
            **headers,
        }

    def call(self, session: dict[str, str], request_id: Any, tool: str) -> dict[str, Any]:
        return answer_of(
            self.post(request_id, "tools/call", {"name": tool, "arguments": {}}, **session)
        )

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=30)


def answer_of(response: httpx2.Response) -> dict[str, Any]:
    text = next(
        (line[6:] for line in response.text.splitlines() if line.startswith("data: {")),
        response.text,
    )
    return json.loads(text)  # type: ignore[no-any-return]


def bearer(role: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {TOKENS[role]}"}


@contextmanager
def serving(
    application: Application, tokens: TokenTable, events: Events | None = None
) -> Iterator[Server]:
    options = HttpOptions(port=0, allowed_origins=(PAGE,))
    with listen(options, tokens) as listener:
        server = make_server(
            application.server, options, HostRules(options), tokens, events or application.events
        )
        thread = threading.Thread(
            target=lambda: asyncio.run(server.serve(sockets=[listener])), daemon=True
        )
        thread.start()
        wait_until(lambda: server.started, 30)
        try:
            yield Server(listener.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join(20)
