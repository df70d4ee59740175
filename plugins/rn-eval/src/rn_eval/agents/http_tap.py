"""HTTP version of the tap: a loopback proxy through which the agent connects to the server."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import httpx2

from roboneuron import StateError

PATH = "/mcp"
_READY_S, _LOOK_S = 60.0, 0.05
_MOST_BODY = 8 << 20
_HOP = frozenset({"connection", "transfer-encoding", "content-length", "keep-alive", "host"})
_EXECUTE = """\
import ctypes, os, sys
PR_SET_PDEATHSIG, SIGTERM = 1, 15
ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, SIGTERM)
os.execv(sys.argv[1], sys.argv[1:])
"""


def free_port() -> int:
    """Return an unused loopback port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def ending_with_parent(command: Sequence[str]) -> list[str]:
    """Command whose process is terminated with its parent, as a process on stdio ends with its
    input.
    """
    return [sys.executable, "-P", "-c", _EXECUTE, *command]


class HttpTap:
    """A proxy for one server. Started by the constructor, ended by `close`.

    Args:
        port: loopback port of the server.
        note_request: called with each message of the agent and its exchange.
        note_answer: called with each message of the server likewise; returns what the agent
            receives.
        has_ended: True if the server has ended.

    Raises:
        StateError: the server does not listen in time.
    """

    def __init__(
        self,
        port: int,
        note_request: Callable[[bytes, str], None],
        note_answer: Callable[[bytes, str], bytes],
        has_ended: Callable[[], bool],
    ) -> None:
        _wait_until_served(port, has_ended)
        # one connection per request, without a bound on their number
        limits = httpx2.Limits(max_connections=None, max_keepalive_connections=0)
        server = httpx2.Client(
            base_url=f"http://127.0.0.1:{port}", timeout=None, limits=limits, trust_env=False
        )

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def _pass_on(self) -> None:
                _pass_on(self, server, note_request, note_answer)

            do_GET = do_POST = do_DELETE = _pass_on

            def log_message(self, *words: object) -> None:
                """Log nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.02,), name="http-tap", daemon=True
        )
        self._thread.start()

    @property
    def url(self) -> str:
        """URL for the agent."""
        return f"http://127.0.0.1:{self._server.server_address[1]}{PATH}"

    def close(self) -> None:
        """Accept no more requests; open ones end with the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _wait_until_served(port: int, has_ended: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + _READY_S
    while time.monotonic() < deadline_s and not has_ended():
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
            return
        time.sleep(_LOOK_S)
    raise StateError("The server over HTTP ended, or did not listen in time.")


def _pass_on(
    handler: BaseHTTPRequestHandler,
    server: httpx2.Client,
    note_request: Callable[[bytes, str], None],
    note_answer: Callable[[bytes, str], bytes],
) -> None:
    """Forward one request and its answer; if the server is gone, the connection is closed."""
    length = int(handler.headers.get("Content-Length") or 0)
    if length > _MOST_BODY:
        handler.send_error(413)
        return
    body = handler.rfile.read(length)
    exchange = f"{id(handler)} "
    if body:
        note_request(body, exchange)
    handler.close_connection = True
    with suppress(OSError, httpx2.HTTPError, httpx2.InvalidURL):
        # built by hand, because the client would add its own headers
        request = httpx2.Request(
            handler.command,
            server.base_url.copy_with(raw_path=handler.path.encode()),
            headers=[(k, v) for k, v in handler.headers.items() if k.lower() not in _HOP],
            content=body or None,
        )
        with closing(server.send(request, stream=True)) as answer:
            handler.send_response(answer.status_code)
            for name, value in answer.headers.multi_items():
                if name.lower() not in _HOP:
                    handler.send_header(name, value)
            handler.send_header("Connection", "close")
            handler.end_headers()
            for part in _parts(answer, lambda message: note_answer(message, exchange)):
                handler.wfile.write(part)
                handler.wfile.flush()


def _parts(answer: httpx2.Response, note_answer: Callable[[bytes], bytes]) -> Iterator[bytes]:
    """The body as the agent receives it; an event stream is passed line by line."""
    if not answer.headers.get("Content-Type", "").startswith("text/event-stream"):
        body = b"".join(answer.iter_raw())
        yield note_answer(body) if body else body
        return
    for line in _lines(answer.iter_raw()):
        if line.startswith(b"data:") and line.strip() != b"data:":
            yield b"data: " + note_answer(line[5:].strip()).strip() + b"\n"
        else:
            yield line


def _lines(parts: Iterable[bytes]) -> Iterator[bytes]:
    """Split into lines with their line ends; the last may have none."""
    rest = b""
    for part in parts:
        *whole, rest = (rest + part).split(b"\n")
        yield from (line + b"\n" for line in whole)
    if rest:
        yield rest
