"""Fixtures: robots and their policy servers; paths of the modules that tests import."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from policy_servers import Robot, RunningServer, Serve, pair, robot_of, servers_in

from rn_backend_shared.backend import SharedBackend
from rn_backend_shared.case import install, options_in
from rn_backend_shared.options import SharedOptions
from rn_backend_shared.server import SharedModelServer
from rn_testing.waiting import wait_until


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

        def make(address: str, **options: Any) -> SharedBackend:
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

        def make(**options: Any) -> SharedBackend:
            given = options_in(tmp_path, **{"idle_s": 30.0, **options})
            made = SharedBackend(SharedOptions.model_validate(given))
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

        def make(**options: Any) -> SharedBackend:
            made = SharedOptions.model_validate(options_in(tmp_path, **options))
            path = tmp_path / "run" / f"{made.identity()}.sock"
            if path not in started:
                server = SharedModelServer(made, path, None)
                started[path] = threading.Thread(target=server.run)
                started[path].start()
                stack.callback(started[path].join, 60.0)
                stack.callback(server.stop)
                wait_until(path.exists, 90.0, "the server listens")
            backend = SharedBackend(made)
            stack.callback(backend.close)
            backend.load()
            return backend

        yield make
    sys.path.remove(str(tmp_path / "site"))
    sys.modules.pop("rn_reflex_plugin", None)
    assert not servers_in(tmp_path), "nothing was spawned"
