"""Policy servers for tests: real processes with small models."""

from __future__ import annotations

import atexit
import errno
import json
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from link_machines import Machine
from link_pairs import admit, make_hub

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import install, options_in
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import SHARED
from rn_backend_openpi.serve_command import name_of
from rn_backend_openpi.statistics import ask_status
from rn_testing.fakes.backend import make_observation
from rn_testing.waiting import wait_until
from roboneuron import ActionChunk, Ahead, NotReadyError, Observation

SEEN = make_observation(SHARED)
PASSING = (
    errno.ECONNABORTED,
    errno.EPROTO,
    errno.EPERM,
    errno.EHOSTUNREACH,
    errno.ENETDOWN,
)
"""Errors after which accept(2) is to be called again."""
WORDS = (sys.executable, "-m", "roboneuron.cli.main", "policy", "serve")


def link_of(state: Path) -> Path:
    """Folder of the link in a state directory."""
    return state / "roboneuron" / "link"


def pair(hub: Path, member: Path, *, name: str = "gpu", address: str = "127.0.0.1") -> None:
    """Pair two state directories."""
    if not link_of(hub).exists():
        make_hub(link_of(hub))
    admit(link_of(hub), link_of(member), name, address)


def toml_of(value: object) -> str:
    """The value in TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml_of(inner)}" for key, inner in value.items()) + "}"
    return json.dumps(value)


class RunningServer:
    """`roboneuron policy serve` in its own folder, with `reflex` under the names of the models.

    Args:
        folder: for all its files; the small model is installed there.
        models: options of `[models.<name>]`.
        listen: options of `[listen]`.
        state: its state directory, which holds its link.
    """

    def __init__(
        self,
        folder: Path,
        models: dict[str, dict[str, Any]],
        listen: dict[str, Any],
        state: Path | None = None,
    ) -> None:
        if not (folder / "site").exists():
            install(folder)
        self.folder = folder
        # not in the folder: a socket's path must be short, and that of a pytest worker is long
        self.run = Path(tempfile.mkdtemp(prefix="rn-"))
        atexit.register(shutil.rmtree, self.run, ignore_errors=True)
        self.config = folder / "policies.toml"
        self._environment = {**os.environ, "XDG_STATE_HOME": str(state or folder / "state")}
        site = options_in(folder)["environment"]
        assert isinstance(site, dict)
        self._environment |= site
        tables: dict[str, Any] = {
            "listen": {"port": 0, "directory": str(self.run), **listen},
            "models": {name: {"backend": "reflex", **given} for name, given in models.items()},
        }
        self.config.write_text("".join(f"{key} = {toml_of(tables[key])}\n" for key in tables))
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        """Pid of the process that robots connect to."""
        assert self._process is not None
        return self._process.pid

    def words(self) -> list[str]:
        """Its command line."""
        return [*WORDS, "--config", str(self.config)]

    def start(self, *words: str, is_ready: bool = True) -> RunningServer:
        """Start it, and wait until it listens; with `is_ready` until all its models are ready."""
        with (self.folder / "server.log").open("ab") as log:
            self._process = subprocess.Popen(
                [*self.words(), *words],
                env=self._environment,
                stdout=log,
                stderr=log,
            )
        wait_until(self._listens, 90.0, "the server listens")
        if is_ready:
            wait_until(self.is_ready, 90.0, "its models are ready")
        return self

    def _listens(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, (self.folder / "server.log").read_text()
        try:
            return bool(self.status())
        except NotReadyError:
            return False

    def is_ready(self) -> bool:
        """True if all models are ready."""
        return all(model["state"] == "ready" for model in self.status()["models"].values())

    def status(self) -> dict[str, Any]:
        """Status of the server."""
        return ask_status(self.run / f"{name_of(self.config)}.sock")

    @property
    def address(self) -> str:
        """Address for robots."""
        return f"127.0.0.1:{self.port}"

    @property
    def port(self) -> int:
        """TCP port."""
        return int(self.status()["address"].rpartition(":")[2])

    def kill(self) -> None:
        """Kill it; its models end by themselves."""
        assert self._process is not None
        self._process.kill()
        self._process.wait(30.0)

    def end(self) -> int:
        """End it, and return its exit status."""
        if self._process is None:
            return 0
        self._process.send_signal(signal.SIGCONT)
        self._process.send_signal(signal.SIGTERM)
        try:
            return self._process.wait(60.0)
        finally:
            self._process.kill()
            self._process.wait(30.0)


class FarServer(RunningServer):
    """A server inside a machine, which must be set before the start."""

    machine: Machine

    def words(self) -> list[str]:
        """Its command line."""
        return self.machine.inside(*super().words())


def robot_of(address: str, **options: Any) -> PolicyBackend:
    """A robot's backend for a server, not loaded."""
    given = {"address": address, "timeout_s": 10.0, "start_timeout_s": 60.0, **options}
    return PolicyBackend(PolicyOptions.model_validate(given))


Serve = Callable[..., RunningServer]
Robot = Callable[..., PolicyBackend]


def seen(number: int) -> Observation:
    """`SEEN` with another image and instruction for each number."""
    frame = SEEN.frames["primary"]
    image = np.full((48, 64, 3), 10 * number, dtype=np.uint8)
    return replace(
        SEEN, frames={"primary": replace(frame, image=image)}, instruction="x" * (number + 1)
    )


def ahead_of(chunk: ActionChunk) -> Ahead:
    """The rows of a chunk after its first, of which three are committed."""
    return Ahead(
        rows=chunk.actions[1:],
        committed_rows=3,
        step_s=chunk.step_s,
        context=chunk.context,
        context_row=1,
    )


def answers(robot: PolicyBackend) -> bool:
    """True if the robot gets an answer; any error other than NotReadyError is raised."""
    try:
        robot.predict(SEEN)
    except NotReadyError:
        return False
    return True


def servers_in(folder: Path) -> list[int]:
    """Server processes whose socket is in the folder."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = entry.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"rn_backend_openpi.server_process" in words and any(
            word.startswith(str(folder).encode()) for word in words
        ):
            found.append(int(entry.parent.name))
    return found


def fail_accepts(monkeypatch: pytest.MonkeyPatch, *numbers: int) -> None:
    """Let the next accepts of each listener of this process fail with these errors."""
    accept = socket.socket.accept
    left: dict[int, list[int]] = {}

    def failing(listener: socket.socket) -> tuple[socket.socket, Any]:
        errors = left.setdefault(listener.fileno(), list(numbers))
        if errors:
            raise OSError(errors.pop(0), "the connection was lost")
        return accept(listener)

    monkeypatch.setattr(socket.socket, "accept", failing)


def said_to(port: int, sent: bytes, context: ssl.SSLContext | None = None) -> bytes:
    """Bytes that an unknown peer receives until the server closes the connection."""
    heard = b""
    connected = socket.create_connection(("127.0.0.1", port), 20.0)
    if context is not None:
        connected = context.wrap_socket(connected)
    with connected, suppress(OSError):
        connected.sendall(sent)
        while part := connected.recv(4096):
            heard += part
    return heard
