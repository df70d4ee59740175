"""A robot's connection to the servers of its model: starts a missing one, and switches to another
one when one dies.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

from rn_backend_shared import wire
from rn_backend_shared.channel import FrameChannel, peer_user
from rn_backend_shared.frames import VersionError
from rn_backend_shared.options import SharedOptions
from rn_backend_shared.session import FAILED, READY, ModelSession, Welcome, check_ready, greet
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
    """Client of one of the servers; used from one thread, except `close`.

    Args:
        options: the model.
    """

    def __init__(self, options: SharedOptions) -> None:
        folder, name = directory_of(options), options.identity()
        self._options = options
        self._paths = [folder / f"{name}-{index}.sock" for index in range(options.replicas)]
        first = os.getpid() % options.replicas  # distributes robots over the replicas
        self._paths = self._paths[first:] + self._paths[:first]
        self._session: ModelSession | None = None
        self._started_s: dict[Path, float] = {}
        self._reviving: threading.Thread | None = None
        self._is_closed = False

    def open(self) -> Welcome:
        """Start the missing servers, and wait for the first one that is ready; returns its
        description of the model.

        Raises:
            RoboNeuronError: the server could not load its model.
            NotReadyError: none was ready in time.
        """
        deadline_s = time.monotonic() + self._options.start_timeout_s
        while True:
            for path in self._paths:
                told = self._greet(path)
                if told is None:
                    self._start(path)
                elif told.state == FAILED:
                    check_ready(told)
                elif told.state == READY:
                    self._start_others()
                    return told
            if time.monotonic() > deadline_s:
                raise NotReadyError(
                    "No server of the shared model was ready within "
                    f"{self._options.start_timeout_s:g} s.",
                    hint=f"Its log is {self._paths[0].with_suffix('.log')}.",
                )
            time.sleep(_POLL_S)

    def ask(self, observation: Observation, deadline_s: float) -> ActionChunk:
        """Request the answer to an observation. A server that dies meanwhile is replaced by another
        ready one.

        Raises:
            NotReadyError: no answer by the deadline, or no server is ready; one is being started.
            RoboNeuronError: the server's error for this observation.
        """
        document = wire.from_observation(observation)
        while True:
            if self._session is None and not any(self._is_ready(path) for path in self._paths):
                self._revive()
                raise NotReadyError(
                    "The server of the shared model is gone; it is being started again."
                )
            assert self._session is not None
            try:
                return self._session.ask(document, deadline_s)
            except TimeoutError as error:
                if len(self._paths) > 1:  # it may hang: use another one next
                    self._paths.append(self._paths.pop(0))
                    self._drop()
                raise NotReadyError(
                    "The shared model did not answer before the deadline."
                ) from error
            except (OSError, ForeignDataError) as error:
                log.warning("The server of the shared model was lost: %s", error)
                self._drop()
                self._revive()
                if time.monotonic() > deadline_s:
                    raise NotReadyError("The server of the shared model was lost.") from error

    def _is_ready(self, path: Path) -> bool:
        told = self._greet(path)
        return told is not None and told.state == READY

    def _greet(self, path: Path) -> Welcome | None:
        """Welcome message of the server at this path; a ready one becomes the current connection.
        None if there is no server.
        """
        connected = socket.socket(socket.AF_UNIX)
        try:
            connected.settimeout(_HELLO_S)
            connected.connect(str(path))
        except OSError:
            connected.close()
            return None
        channel = FrameChannel(connected)
        is_kept = False
        try:
            if peer_user(connected) != os.getuid():
                raise ConfigurationError(f"{path} belongs to another user.")
            told = greet(channel, {}, _HELLO_S)
            is_kept = told.state == READY and not self._is_closed
        except VersionError as error:
            raise ConfigurationError(f"The server at {path} cannot be used: {error}.") from error
        except (OSError, ForeignDataError):
            return None
        finally:
            if not is_kept:
                channel.close()
        if is_kept:
            self._drop()
            self._session = ModelSession(channel, told)
        return told

    def _start_others(self) -> None:
        for path in self._paths:
            if not path.exists():
                self._start(path)

    def _start(self, path: Path) -> None:
        """Start a server in the background, unless it was just started. If one is already running,
        the new one ends at once.
        """
        now_s = time.monotonic()
        if now_s - self._started_s.get(path, -_AGAIN_S) < _AGAIN_S:
            return
        self._started_s[path] = now_s
        python = str(self._options.python or sys.executable)
        try:
            subprocess.run(
                [python, "-P", "-m", "rn_backend_shared.server_process", str(path)],
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
        """Start missing servers on another thread, so that a robot never waits for a process."""
        if self._reviving is not None and self._reviving.is_alive():
            return

        def start() -> None:
            # one that died soon after its start is not restarted immediately
            end_s = time.monotonic() + 2 * _AGAIN_S
            try:
                while not self._is_closed and time.monotonic() < end_s:
                    gone = [path for path in self._paths if not _is_served(path)]
                    for path in gone:
                        self._start(path)
                    if not gone:
                        return
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
