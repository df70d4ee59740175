"""Supervision of the process of one model: it is restarted with growing pauses when it dies or
hangs.
"""

from __future__ import annotations

import logging
import os
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import InvalidHandshake

from rn_backend_openpi.description import FAILED, LOADING, READY
from rn_backend_openpi.links import spawn
from rn_backend_openpi.listener import CountedConnection
from rn_backend_openpi.messages import Document, from_error, raise_told
from rn_backend_openpi.relay import carry, reach, turn_away
from rn_backend_openpi.server_options import ServedModelOptions
from rn_backend_openpi.server_process import STAY
from rn_backend_openpi.statistics import page
from roboneuron import (
    ConfigurationError,
    ForeignDataError,
    NotReadyError,
    RoboNeuronError,
    foreign,
)

log = logging.getLogger(__name__)
DEAD = "dead"
"""State without a process, in a pause before its next start."""
_GREET_S = 1.0
_LOOK_S, _READY_LOOK_S = 0.1, 1.0
_HANGS_S = 15.0
"""Time without a welcome message after which a process is killed."""
_FIRST_PAUSE_S, _LAST_PAUSE_S = 0.5, 30.0
_WELL_S = 60.0
"""Time without a fault after which the pauses are reset."""
_END_S = 20.0
_MOST_PATH_BYTES = 107
"""Size of a path in Linux's sockaddr_un, without the final zero."""


class ModelProcess:
    """Runs one model in its own process, from `start` to `close`.

    Args:
        name: name of the model.
        options: options of the model.
        path: socket of its process; the log is next to it.

    Raises:
        ConfigurationError: the path is too long for a socket.
    """

    def __init__(self, name: str, options: ServedModelOptions, path: Path) -> None:
        if len(os.fsencode(path)) > _MOST_PATH_BYTES:
            raise ConfigurationError(
                f"{path} is too long for a socket: {len(os.fsencode(path))} bytes, at most "
                f"{_MOST_PATH_BYTES}.",
                hint="Name a shorter `directory` under [listen].",
            )
        self.name = name
        self.path = path
        self.log_path = path.with_suffix(".log")
        self._options = options
        self._end = threading.Event()
        self._process: subprocess.Popen[str] | None = None
        self._state = LOADING
        self._failure: Document | None = None
        self._restarts = 0
        self._thread = threading.Thread(target=self._keep, name=f"model {name}", daemon=True)

    @property
    def state(self) -> str:
        """`LOADING`, `READY`, `FAILED` or `DEAD`."""
        return self._state

    def start(self) -> None:
        """Start the process and its supervision."""
        self._thread.start()

    def stop(self) -> None:
        """Request the end."""
        self._end.set()

    def close(self) -> None:
        """End the process, and wait for it; idempotent."""
        self.stop()
        if self._thread.ident is not None:
            self._thread.join(2 * _END_S)

    async def relay(self, robot: ServerConnection, note: Callable[[float], None]) -> int:
        """Hand on the bytes of a robot and of the process until one of them disconnects; see
        `RelayedModel`.
        """
        try:
            there = await reach(self.path)
        except (OSError, InvalidHandshake):
            await turn_away(robot, self._failure)
            return 0
        async with there:
            assert isinstance(robot, CountedConnection)
            return await carry(robot, there, self.name, note)

    def status(self) -> Document:
        """Statistics, including those of its process if it answers."""
        process = self._process
        own: Document = {
            "state": self._state,
            "pid": None if process is None else process.pid,
            "restarts": self._restarts,
            "log": str(self.log_path),
        }
        if self._failure is not None:
            own["failure"] = self._failure["message"]
        try:
            return {**own, **page(self.path, _GREET_S), "state": self._state}
        except (OSError, ForeignDataError):
            return own

    def _keep(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._end.is_set():
            begun_s = time.monotonic()
            self._state = LOADING
            try:
                self._process = spawn(self._options, self.path, STAY)
            except OSError as error:
                log.error("The model %s cannot be started: %s", self.name, error)
                refusal = NotReadyError(f"The model {self.name!r} cannot be started: {error}.")
                self._failure = from_error(refusal)
            else:
                log.info("The model %s is process %d.", self.name, self._process.pid)
                self._watch(self._process)
            if self._end.is_set():
                break
            if self._state != FAILED:
                self._state = DEAD
            if time.monotonic() - begun_s > _WELL_S:
                pause_s = _FIRST_PAUSE_S
            log.warning("The model %s is restarted in %g s.", self.name, pause_s)
            self._end.wait(pause_s)
            pause_s = min(2 * pause_s, _LAST_PAUSE_S)
            self._restarts += 1

    def _watch(self, process: subprocess.Popen[str]) -> None:
        """Monitor a process until it ends, or `stop` is called."""
        heard_s = looked_s = time.monotonic()
        while process.poll() is None and not self._end.wait(_LOOK_S):
            now_s = time.monotonic()
            if self._state == READY and now_s - looked_s < _READY_LOOK_S:
                continue
            looked_s = now_s
            if self._look(process):
                heard_s = now_s
            elif self._state == READY and now_s - heard_s > _HANGS_S:
                log.error("The model %s hangs and is killed.", self.name)
                process.kill()
        assert process.stdin is not None
        process.stdin.close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if not self._end.is_set():
            log.warning("The model %s has ended with %s.", self.name, process.returncode)

    def _look(self, process: subprocess.Popen[str]) -> bool:
        """True if the process answers."""
        try:
            told = page(self.path, _GREET_S)
            state = foreign.text(foreign.field(told, "state"), "state")
            failure = _failure(told)
        except (OSError, ForeignDataError):
            return False
        if told.get("pid") != process.pid:  # an old process; the new one ends at once
            return False
        if state != self._state:
            log.info("The model %s is %s.", self.name, state)
        self._state = state
        self._failure = failure
        return True


def _failure(status: Document) -> Document | None:
    """The error in a status, checked; raises ForeignDataError."""
    try:
        raise_told(status)
    except ForeignDataError:
        raise
    except RoboNeuronError as error:
        return from_error(error)
    return None
