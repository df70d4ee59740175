"""A robot's connection to the server of its model on this machine, which is started if missing."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

from rn_backend_openpi.connection import PolicyConnection
from rn_backend_openpi.messages import from_observation
from rn_backend_openpi.session import FAILED, READY, ModelSession, Welcome, check_ready, receive
from rn_backend_openpi.shared_options import SharedOptions
from roboneuron import (
    ActionChunk,
    ConfigurationError,
    ForeignDataError,
    NotReadyError,
    Observation,
)

log = logging.getLogger(__name__)
_HELLO_S = 0.5
_SPAWN_S = 60.0
_AGAIN_S = 2.0
"""Shortest time between two starts of the same server."""
_POLL_S = 0.02


def directory_of(options: SharedOptions) -> Path:
    """Folder of sockets and logs. Raises as `private_directory`."""
    return private_directory(options.directory)


def private_directory(chosen: Path | None) -> Path:
    """Create a folder for sockets and logs that only this user can access.

    Args:
        chosen: None for one in the user's run-time directory.

    Raises:
        ConfigurationError: it cannot be created, or is accessible to others.
    """
    path = chosen
    if path is None:
        base = os.environ.get("XDG_RUNTIME_DIR")
        path = Path(base) / "roboneuron" if base else Path(f"/tmp/roboneuron-{os.getuid()}")
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise ConfigurationError(
            f"The directory {path} of shared models cannot be used: {error}."
        ) from error
    if found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise ConfigurationError(
            f"The directory {path} of shared models must be private to this user (mode 700)."
        )
    return path


class Links:
    """Client of the server; used from one thread, except `close`.

    Args:
        options: the model.
    """

    def __init__(self, options: SharedOptions) -> None:
        self._options = options
        self._path = directory_of(options) / f"{options.identity()}.sock"
        self._session: ModelSession | None = None
        self._started_s = -_AGAIN_S
        self._reviving: threading.Thread | None = None
        self._is_closed = False

    def open(self) -> Welcome:
        """Start the server if it is missing, and wait until it is ready; returns its description of
        the model.

        Raises:
            RoboNeuronError: the server could not load its model.
            NotReadyError: it was not ready in time.
        """
        deadline_s = time.monotonic() + self._options.start_timeout_s
        while True:
            told = self._greet()
            if told is None:
                self._start()
            elif told.state == FAILED:
                check_ready(told)
            elif told.state == READY:
                return told
            if time.monotonic() > deadline_s:
                raise NotReadyError(
                    "The server of the shared model was not ready within "
                    f"{self._options.start_timeout_s:g} s.",
                    hint=f"Its log is {self._path.with_suffix('.log')}.",
                )
            time.sleep(_POLL_S)

    def ask(self, observation: Observation, deadline_s: float) -> ActionChunk:
        """Request the answer to an observation.

        Raises:
            NotReadyError: no answer by the deadline, or the server is gone and being started.
            RoboNeuronError: the server's error for this observation.
        """
        document = from_observation(observation)
        while True:
            if self._session is None and not self._is_ready():
                self._revive()
                raise NotReadyError(
                    "The server of the shared model is gone; it is being started again."
                )
            assert self._session is not None
            try:
                return self._session.ask(document, deadline_s)
            except TimeoutError as error:
                raise NotReadyError(
                    "The shared model did not answer before the deadline."
                ) from error
            except (OSError, ForeignDataError) as error:
                log.warning("The server of the shared model was lost: %s", error)
                self._drop()
                self._revive()
                if time.monotonic() > deadline_s:
                    raise NotReadyError("The server of the shared model was lost.") from error

    def _is_ready(self) -> bool:
        told = self._greet()
        return told is not None and told.state == READY

    def _greet(self) -> Welcome | None:
        """Welcome message of the server; a ready one becomes the current connection. None if there
        is no server.
        """
        deadline_s = time.monotonic() + _HELLO_S
        connected = socket.socket(socket.AF_UNIX)
        connection = PolicyConnection(connected, "ws://localhost/")
        is_kept = False
        try:
            connected.settimeout(_HELLO_S)
            connected.connect(str(self._path))
            connection.open(deadline_s)
            told = Welcome.of(receive(connection, deadline_s))
            is_kept = told.state == READY and not self._is_closed
        except (OSError, ForeignDataError):
            return None
        finally:
            if not is_kept:
                connection.close()
        if is_kept:
            self._drop()
            self._session = ModelSession(connection, told)
        return told

    def _start(self) -> None:
        """Start the server in the background, unless it was just started. If one is already
        running, the new one ends at once.
        """
        now_s = time.monotonic()
        if now_s - self._started_s < _AGAIN_S:
            return
        self._started_s = now_s
        python = str(self._options.python or sys.executable)
        try:
            subprocess.run(
                [python, "-P", "-m", "rn_backend_openpi.server_process", str(self._path)],
                input=self._options.model_dump_json() + "\n",
                env={**os.environ, **self._options.environment},
                check=True,
                capture_output=True,
                text=True,
                timeout=_SPAWN_S,
            )
        except subprocess.CalledProcessError as error:
            lines = error.stderr.strip().splitlines() or ["it printed nothing"]
            raise ConfigurationError(
                f"The server of the shared model cannot be started: {lines[-1]}."
            ) from error
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ConfigurationError(
                f"The server of the shared model cannot be started: {error}."
            ) from error

    def _revive(self) -> None:
        """Start a missing server on another thread, so that a robot never waits for a process."""
        if self._reviving is not None and self._reviving.is_alive():
            return

        def start() -> None:
            # one that died soon after its start is not restarted immediately
            end_s = time.monotonic() + 2 * _AGAIN_S
            try:
                while not self._is_closed and time.monotonic() < end_s:
                    if _is_served(self._path):
                        return
                    self._start()
                    time.sleep(_POLL_S)
            except ConfigurationError as error:
                log.error("%s", error)

        self._reviving = threading.Thread(target=start, name="revive", daemon=True)
        self._reviving.start()

    def _drop(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            session.close()

    def close(self) -> None:
        """Disconnect; idempotent. The server ends after a time without requests."""
        self._is_closed = True
        self._drop()
        if self._reviving is not None:
            self._reviving.join(_SPAWN_S)


def _is_served(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(_HELLO_S)
        return probe.connect_ex(str(path)) == 0
