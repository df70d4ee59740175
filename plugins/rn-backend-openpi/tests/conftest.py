"""Fixtures: a stand-in for openpi's server with options of its clients; robots, and servers."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from foreign_engines import ScriptedServer
from openpi_clients import TIMEOUT_S
from policy_servers import Robot, RunningServer, Serve, pair, robot_of, servers_in

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import install, options_in
from rn_backend_openpi.front import PolicyServer
from rn_backend_openpi.model_server import SharedModelServer
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.processes import ModelProcess
from rn_backend_openpi.server_options import PolicyServerOptions
from rn_testing.waiting import wait_until


@pytest.fixture
def policy_server() -> Iterator[ScriptedServer]:
    """A running stand-in."""
    server = ScriptedServer()
    server.start()
    yield server
    server.stop()


@pytest.fixture
def options(policy_server: ScriptedServer) -> Callable[..., PolicyOptions]:
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


@pytest.fixture
def front(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., PolicyServer]]:
    """Return a function that starts a server without a model in this process."""
    monkeypatch.setattr(ModelProcess, "start", lambda process: None)
    (tmp_path / "run").mkdir(mode=0o700)
    with ExitStack() as stack:

        def start(**listen: Any) -> PolicyServer:
            tables = {
                "listen": {"port": 0, "keys": "none", **listen},
                "models": {"only": {"backend": "reflex"}},
            }
            server = PolicyServer(
                PolicyServerOptions.model_validate(tables), tmp_path / "run", "front"
            )
            thread = threading.Thread(target=server.run)
            stack.callback(thread.join, 60.0)
            stack.callback(server.stop)
            thread.start()
            assert server.has_begun.wait(30.0)
            return server

        yield start
