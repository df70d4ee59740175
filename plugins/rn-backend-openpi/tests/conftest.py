"""Fixtures: a stand-in for openpi's server, and options of its clients."""

from __future__ import annotations

import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
import pytest
from openpi_clients import TIMEOUT_S
from openpi_format import decode, encode
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

from rn_backend_openpi.options import OpenpiOptions


class PolicyServer:
    """Replacement of openpi's policy server on a free loopback port: metadata first, then one reply
    per request. `greet` may wait before the metadata are sent.

    `answer` gets each request and returns the reply's map; it may raise (a text frame with a
    traceback, then close 1011, as openpi does), return bytes or text to be sent unchanged, or use
    `connection` itself and return None.
    """

    def __init__(self) -> None:
        self.answer: Callable[[dict[Any, Any]], Any] = lambda request: {
            "actions": np.zeros((10, 7))
        }
        self.metadata: Any = {"policy": "stand-in"}
        self.greet: Callable[[ServerConnection], object] = lambda connection: None
        self.requests: deque[dict[Any, Any]] = deque(maxlen=8)  # images are large
        self.headers: list[Any] = []
        self.connection: ServerConnection | None = None
        self.released = threading.Event()
        self.tls: ssl.SSLContext | None = None
        self._server: Server | None = None
        self.port = 0

    @property
    def url(self) -> str:
        return f"{'wss' if self.tls else 'ws'}://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Start listening; the second time on the same port."""
        deadline_s = time.monotonic() + 5.0
        while True:
            try:
                self._server = serve(
                    self._handle,
                    "127.0.0.1",
                    self.port,
                    compression=None,
                    max_size=None,
                    ssl=self.tls,
                )
                break
            except OSError:
                if time.monotonic() > deadline_s:
                    raise
                self.released.wait(0.02)
        self.port = self._server.socket.getsockname()[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def stop(self) -> None:
        """Stop listening and cut the connection, like a killed process."""
        if self._server is not None:
            self._server.shutdown()
            self._server = None
        self.cut()

    def cut(self) -> None:
        """Cut the current connection without a closing handshake."""
        if self.connection is not None:
            with suppress(OSError):
                self.connection.socket.shutdown(2)

    def _handle(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.headers.append(connection.request.headers if connection.request else {})
        with suppress(ConnectionClosed):
            self.greet(connection)
            connection.send(self._packed(self.metadata))
            while True:
                request = msgpack.unpackb(connection.recv(), object_hook=decode)
                self.requests.append(request)
                try:
                    reply = self.answer(request)
                except ValueError as error:
                    connection.send(
                        f"Traceback (most recent call last):\n  ...\nValueError: {error}"
                    )
                    connection.close(code=1011, reason="Internal server error.")
                    return
                if reply is not None:
                    connection.send(self._packed(reply))

    @staticmethod
    def _packed(reply: Any) -> Any:
        return reply if isinstance(reply, bytes | str) else msgpack.packb(reply, default=encode)


@pytest.fixture
def policy_server() -> Iterator[PolicyServer]:
    """A running stand-in."""
    server = PolicyServer()
    server.start()
    yield server
    server.released.set()
    server.stop()


@pytest.fixture
def options(policy_server: Any) -> Callable[..., OpenpiOptions]:
    """Create options for the stand-in."""

    def make(**changes: Any) -> OpenpiOptions:
        values = {
            "url": policy_server.url,
            "profile": "libero",
            "image_keys": {"primary": "observation/image"},
            "connect_timeout_s": 5.0,
            "warm_up_timeout_s": 5.0,
            "request_timeout_s": TIMEOUT_S,
        }
        return OpenpiOptions(**(values | changes))

    return make
