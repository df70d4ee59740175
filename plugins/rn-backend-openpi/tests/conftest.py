"""Fixtures: a stand-in for openpi's server with options of its clients; robots, and servers."""

from __future__ import annotations

import os
import signal
import ssl
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from openpi_clients import TIMEOUT_S
from openpi_format import decode, encode
from policy_servers import Robot, RunningServer, Serve, pair, robot_of, servers_in
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection
from websockets.sync.server import serve as serve_websocket

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import install, options_in
from rn_backend_openpi.model_server import SharedModelServer
from rn_backend_openpi.options import PolicyOptions
from rn_testing.waiting import wait_until


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
                self._server = serve_websocket(
                    self._handle,
                    "127.0.0.1",
                    self.port,
                    compression=None,
                    max_size=None,
                    close_timeout=0.2,  # robots read nothing while they wait for no answer
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
def options(policy_server: Any) -> Callable[..., PolicyOptions]:
    """Create options for the stand-in."""

    def make(**changes: Any) -> PolicyOptions:
        values = {
            "url": policy_server.url,
            "profile": "libero",
            "image_keys": {"primary": "observation/image"},
            "start_timeout_s": 5.0,
            "warm_up_timeout_s": 5.0,
            "timeout_s": TIMEOUT_S,
        }
        return PolicyOptions(**(values | changes))

    return make


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A server without encryption."""
    folder = tmp_path_factory.mktemp("plain")
    listen = {"keys": "token", "token_file": str(folder / "token")}
    server = RunningServer(folder, {"only": {}}, listen).start()
    yield server
    server.end()


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    """Return a function that starts a server; its keys are those of a pair, or a token."""
    with ExitStack() as stack:

        def start(
            models: dict[str, dict[str, Any]] | None = None, *, is_ready: bool = True, **listen: Any
        ) -> RunningServer:
            if listen.get("keys") == "token":
                listen = {"token_file": str(tmp_path / "token"), **listen}
            else:
                pair(tmp_path / "robot", tmp_path / "gpu")
            made = RunningServer(tmp_path, models or {"only": {}}, listen, tmp_path / "gpu")
            stack.callback(made.end)
            return made.start(is_ready=is_ready)

        yield start


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    """Return a function that creates a loaded backend of a robot."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "robot"))
    with ExitStack() as stack:

        def make(address: str, **options: Any) -> PolicyBackend:
            made = robot_of(address, **options)
            stack.callback(made.close)
            made.load()
            return made

        yield make


@pytest.fixture
def spawned(tmp_path: Path) -> Iterator[Robot]:
    """Return a function that creates a loaded backend, whose server ends with the test."""
    install(tmp_path)
    with ExitStack() as stack:

        def make(**options: Any) -> PolicyBackend:
            given = options_in(tmp_path, **{"idle_s": 30.0, **options})
            made = PolicyBackend(PolicyOptions.model_validate(given))
            stack.callback(made.close)
            made.load()
            return made

        yield make
    for pid in servers_in(tmp_path):
        os.kill(pid, signal.SIGKILL)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Robot]:
    """As `spawned`, with the server on a thread of this process: faster, for tests in which no
    process must die.
    """
    install(tmp_path)
    sys.path.insert(0, str(tmp_path / "site"))
    with ExitStack() as stack:
        started: dict[Path, threading.Thread] = {}

        def make(**options: Any) -> PolicyBackend:
            made = PolicyOptions.model_validate(options_in(tmp_path, **options))
            path = tmp_path / "run" / f"{made.identity()}.sock"
            if path not in started:
                server = SharedModelServer(made.of_the_model(), path, None)
                started[path] = threading.Thread(target=server.run)
                started[path].start()
                stack.callback(started[path].join, 60.0)
                stack.callback(server.stop)
                wait_until(path.exists, 90.0, "the server listens")
            backend = PolicyBackend(made)
            stack.callback(backend.close)
            backend.load()
            return backend

        yield make
    sys.path.remove(str(tmp_path / "site"))
    assert not servers_in(tmp_path), "nothing was spawned"
