"""Clients that call a tool and cancel it by hand, over HTTP and stdio, in every protocol."""

from __future__ import annotations

import json
import os
import queue
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

import httpx2
import psutil
from mcp_types import CLIENT_CAPABILITIES_META_KEY, PROTOCOL_VERSION_META_KEY
from mcp_types.version import HANDSHAKE_PROTOCOL_VERSIONS

from rn_testing.waiting import holds_within, wait_until

Way = Literal[
    "notification",
    "id as text",
    "stream closed",
    "client killed",
    "session deleted",
    "stdin closed",
    "wrong id",
]
"""How a call is cancelled. A killed client's connections are reset; over stdio the process that
holds the pipes is killed.
"""
HTTP_WAYS: tuple[Way, ...] = (
    *("notification", "id as text", "stream closed", "client killed", "session deleted"),
    "wrong id",
)
STDIO_WAYS: tuple[Way, ...] = (
    *("notification", "id as text", "wrong id", "client killed", "stdin closed"),
)
LAST_WAYS: tuple[Way, ...] = ("client killed", "stdin closed")
"""Over stdio the server ends with them."""
ACCEPT = "application/json, text/event-stream"
TOKEN = "the-token-of-this-test"
TOKENS = """
[[http.tokens]]
name = "operator"
role = "admin"
variable = "TEST_TOKEN"
"""
"""Part of a server's configuration: every client has this token, so that all are one operator."""
HELLO = {"capabilities": {}, "clientInfo": {"name": "by-hand", "version": "1"}}
_RESET = struct.pack("ii", 1, 0)
"""SO_LINGER with a time of 0: close() resets the connection."""
_HOLDER = """
import subprocess, sys, threading
server = subprocess.Popen(sys.argv[2:], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
with open(sys.argv[1], "w") as file:
    file.write(str(server.pid))
def copy(source, sink):
    while data := source.read1(65536):
        sink.write(data)
        sink.flush()
    sink.close()
threading.Thread(target=copy, args=(server.stdout, sys.stdout.buffer), daemon=True).start()
copy(sys.stdin.buffer, server.stdin)
server.wait()
"""
"""A process that starts a server and holds its pipes, as a client does; it can be killed."""


class WireClient:
    """A client of one protocol version; `begin` one call, then `cancel` it."""

    def __init__(self, version: str) -> None:
        self.version = version
        self.number = 100

    @property
    def has_session(self) -> bool:
        """The protocol begins with a handshake."""
        return self.version in HANDSHAKE_PROTOCOL_VERSIONS

    def message(self, method: str, params: Mapping[str, Any], is_request: bool) -> dict[str, Any]:
        """A message with the metadata of the protocol; a request gets the next number."""
        meta: dict[str, Any] = {}
        if not self.has_session and is_request:
            meta |= {PROTOCOL_VERSION_META_KEY: self.version, CLIENT_CAPABILITIES_META_KEY: {}}
        told: dict[str, Any] = {
            "jsonrpc": "2.0",
            "method": method,
            "params": {**params, "_meta": meta},
        }
        if is_request:
            self.number += 1
            told["id"] = self.number
            meta["progressToken"] = f"t{self.number}"
        return told

    def has_progress(self) -> bool:
        """The server has reported progress of the last call."""
        return f'"progressToken":"t{self.number}"' in self.said().replace(" ", "")

    def has_answered(self) -> bool:
        """The last call has an answer."""
        return f'"id":{self.number},' in self.said().replace(" ", "").replace("}", ",")

    def has_succeeded(self) -> bool:
        """The last call has an answer, which is no error."""
        return self.has_answered() and '"structuredContent"' in self.said()

    def said(self) -> str:
        """What the server has sent for the last call so far, or more."""
        raise NotImplementedError

    def call(self, tool: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """The result of a call that must succeed."""
        params = {"name": tool, "arguments": arguments}
        answer = self._answer(self.message("tools/call", params, is_request=True))
        assert not answer["result"].get("isError"), answer
        return dict(answer["result"]["structuredContent"])

    def failure(self, tool: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """The error of a call that must fail."""
        params = {"name": tool, "arguments": arguments}
        answer = self._answer(self.message("tools/call", params, is_request=True))
        assert answer["result"].get("isError"), answer
        return dict(answer["result"]["_meta"]["roboneuron/error"])

    def _answer(self, message: dict[str, Any]) -> dict[str, Any]:
        raise NotImplementedError

    def cancelled(self, way: Way) -> dict[str, Any]:
        """The notification for the last call."""
        shown = {"id as text": str(self.number), "wrong id": self.number + 1000}
        params = {"requestId": shown.get(way, self.number)}
        return self.message("notifications/cancelled", params, is_request=False)


class HttpClient(WireClient):
    """Over streamable HTTP; every call has a connection of its own."""

    transport = "http"

    def __init__(self, url: str, version: str) -> None:
        super().__init__(version)
        self._url = url
        self._headers = {
            "Accept": ACCEPT,
            "Content-Type": "application/json",
            "Authorization": f"Bearer {TOKEN}",
        }
        if self.has_session:
            hello = {"protocolVersion": version, **HELLO}
            answer = self._post(self.message("initialize", hello, is_request=True))
            answer.raise_for_status()
            self._headers["Mcp-Session-Id"] = answer.headers["mcp-session-id"]
            self._headers["MCP-Protocol-Version"] = version
            self._post(self.message("notifications/initialized", {}, is_request=False))
        self._headers["MCP-Protocol-Version"] = version
        self._call: socket.socket | None = None
        self._seen = b""

    def _post(self, message: dict[str, Any], **headers: str) -> httpx2.Response:
        # verify: to load the certificates takes most of the time of a request
        return httpx2.post(
            self._url, json=message, headers={**self._headers, **headers}, timeout=180, verify=False
        )

    def _named(self, tool: str) -> dict[str, str]:
        return {} if self.has_session else {"Mcp-Method": "tools/call", "Mcp-Name": tool}

    def begin(self, tool: str, arguments: Mapping[str, Any]) -> None:
        """Call a tool, and leave the answer unread; the last call is left."""
        params = {"name": tool, "arguments": arguments}
        body = json.dumps(self.message("tools/call", params, is_request=True)).encode()
        where = urlsplit(self._url)
        headers = {
            "Host": where.netloc,
            "Content-Length": str(len(body)),
            **self._headers,
            **self._named(tool),
        }
        head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
        self._seen = b""
        self.leave_call()
        self._call = socket.create_connection((where.hostname, where.port), timeout=60)
        self._call.sendall(f"POST {where.path} HTTP/1.1\r\n{head}\r\n".encode() + body)

    def cancel(self, way: Way) -> int:
        """Cancel the last call; return the status of the answer, 0 where there is none."""
        assert self._call is not None
        if way == "session deleted":
            return httpx2.delete(self._url, headers=self._headers, timeout=60).status_code
        if way == "stream closed":
            self._call.close()
        elif way == "client killed":
            self._call.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            self._call.close()
        else:
            return self._post(self.cancelled(way)).status_code
        return 0

    def _answer(self, message: dict[str, Any]) -> dict[str, Any]:
        answer = self._post(message, **self._named(message["params"]["name"]))
        lines = answer.text.splitlines()
        told = [json.loads(line[6:]) for line in lines if line.startswith("data: {")]
        return next((one for one in told if "id" in one), None) or dict(answer.json())

    def said(self) -> str:
        """What the server has sent for the last call so far."""
        assert self._call is not None
        with suppress(OSError):  # nothing new, or the connection is closed
            self._call.setblocking(False)
            self._seen += self._call.recv(65536)
        return self._seen.decode(errors="replace")

    def leave_call(self) -> None:
        """Close the connection of the last call."""
        if self._call is not None:
            self._call.close()


class StdioClient(WireClient):
    """Over the pipes of a server process."""

    transport = "stdio"

    def __init__(self, process: subprocess.Popen[bytes], version: str) -> None:
        super().__init__(version)
        self._process = process
        self._lines: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._seen = ""
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()
        if self.has_session:
            hello = {"protocolVersion": version, **HELLO}
            self._send(self.message("initialize", hello, is_request=True))
            assert self._lines.get(timeout=60)["result"]["protocolVersion"] == version
            self._send(self.message("notifications/initialized", {}, is_request=False))

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._seen += line.decode()
                self._lines.put(json.loads(line))

    def _send(self, message: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(message).encode() + b"\n")
        self._process.stdin.flush()

    def begin(self, tool: str, arguments: Mapping[str, Any]) -> None:
        """Call a tool."""
        self._seen = ""
        params = {"name": tool, "arguments": arguments}
        self._send(self.message("tools/call", params, is_request=True))

    def cancel(self, way: Way) -> int:
        """Cancel the last call; a notification has no answer."""
        if way == "stdin closed":
            assert self._process.stdin is not None
            self._process.stdin.close()
        elif way == "client killed":
            self._process.kill()
        else:
            self._send(self.cancelled(way))
        return 0

    def _answer(self, message: dict[str, Any]) -> dict[str, Any]:
        self._send(message)
        while (line := self._lines.get(timeout=180)).get("id") != message["id"]:
            pass
        return line

    def said(self) -> str:
        """What the server has sent since the last call began."""
        return self._seen

    def leave_call(self) -> None:
        """A call has no connection of its own."""


@contextmanager
def served(
    configuration: Path, environment: Mapping[str, str], *, transport: str
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """A server process, and its URL over HTTP."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "roboneuron.cli.main", "serve", "--config"]
    command += [str(configuration), "--log-level", "warning", "--transport", transport]
    pipe = subprocess.PIPE if transport == "stdio" else subprocess.DEVNULL
    log, number = configuration.with_suffix(".log"), configuration.with_suffix(".pid")
    if transport == "http":
        command += ["--port", str(port)]
    else:
        command = [sys.executable, "-c", _HOLDER, str(number), *command]
    with log.open("ab") as file:
        process = subprocess.Popen(
            command,
            env={**os.environ, **environment, "TEST_TOKEN": TOKEN},
            stdin=pipe,
            stdout=pipe,
            stderr=file,
        )
    try:
        if transport == "http":

            def is_open() -> bool:
                with socket.socket() as probe:
                    return probe.connect_ex(("127.0.0.1", port)) == 0

            wait_until(lambda: process.poll() is not None or is_open(), 120.0, "the server listens")
        assert process.poll() is None, log.read_text()
        yield process, f"http://127.0.0.1:{port}/mcp"
    finally:
        if process.stdin is not None:
            with suppress(OSError):
                process.stdin.close()
        if transport == "http":
            process.terminate()
        process.wait(60)
        if transport == "stdio":
            pid = int(number.read_text())
            wait_until(lambda: not psutil.pid_exists(pid), 60.0, "the server ends with its client")


def answered(transport: str, version: str, way: Way) -> int:
    """Status of the answer to a cancellation; 0 where there is none."""
    if transport == "stdio" or way in ("stream closed", "client killed"):
        return 0
    if way == "session deleted":
        return 200
    return 400 if way == "wrong id" and version not in HANDSHAKE_PROTOCOL_VERSIONS else 202


TO_REPEAT = ('"rule":"ownership"', "The server was frozen")
"""Answers after which the same call is made again."""


def check_cell(
    client: HttpClient | StdioClient,
    way: Way,
    call: tuple[str, Mapping[str, Any]],
    moves: Callable[[], bool],
    rests: Callable[[], bool],
    rest_s: float,
) -> str:
    """Call, wait for the motion, cancel it in a way, wait for rest; return how long that took."""

    def started() -> bool:
        # the call before is still ending, or a busy machine kept the server from running
        if client.has_answered() and any(words in client.said() for words in TO_REPEAT):
            client.begin(*call)
        return moves()

    try:
        client.begin(*call)
        assert holds_within(started, 60.0), f"{call[0]} moves nothing: {client.said()[-2000:]}"
        assert client.cancel(way) == answered(client.transport, client.version, way)
        if way == "wrong id":
            assert not holds_within(client.has_answered, 0.3), "the call of another id was ended"
            assert holds_within(moves, 1.0), "the motion of another id was ended"
            client.cancel("notification")
        since_s = time.monotonic()
        wait_until(rests, rest_s, f"rest after {way}")
        took_s = time.monotonic() - since_s
        assert not holds_within(moves, 0.5), "it moves again"
    finally:
        client.leave_call()
    return f"{took_s * 1e3:.0f} ms"
