"""Processes of models on this machine, their sockets and logs; the server that the first robot
starts.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from rn_backend_openpi.options import ModelOptions, PolicyOptions
from roboneuron import ConfigurationError

_HELLO_S = 0.5
_SPAWN_S = 60.0
_AGAIN_S = 2.0
"""Shortest time between two starts of the same server."""
_MOST_LOG_BYTES = 10_000_000


def socket_of(options: PolicyOptions) -> Path:
    """Path of the socket of a model's server, and of its log. Raises as `private_directory`."""
    return private_directory(options.directory) / f"{options.identity()}.sock"


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


def spawn(options: ModelOptions, path: Path, *mode: str) -> subprocess.Popen[str]:
    """Start the process of a model's server, in a session of its own.

    Args:
        options: those of the model.
        path: its socket; the log is next to it.
        mode: see `server_process.main`.

    Raises:
        OSError: it cannot be started.
    """
    log_path = path.with_suffix(".log")
    if log_path.exists() and log_path.stat().st_size > _MOST_LOG_BYTES:
        log_path.replace(log_path.with_suffix(".log.1"))
    python = str(options.python or sys.executable)
    with log_path.open("a") as output:
        process = subprocess.Popen(
            [python, "-P", "-m", "rn_backend_openpi.server_process", *mode, str(path)],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=output,
            text=True,
            env={**os.environ, **options.environment},
            start_new_session=True,  # Ctrl-C ends the supervisor, which ends this process
        )
    assert process.stdin is not None
    with suppress(BrokenPipeError):  # it has died already, which is detected later
        process.stdin.write(options.of_the_model().model_dump_json(exclude_unset=True) + "\n")
        process.stdin.flush()
    return process


class LocalServer:
    """The server of a model at a Unix socket.

    Args:
        options: the model.

    Attributes:
        path: path of the socket; the log is next to it.
    """

    def __init__(self, options: PolicyOptions) -> None:
        self._options = options
        self.path = socket_of(options)
        self._started_s = -_AGAIN_S

    def connect(self) -> socket.socket:
        """Connect to it. Raises OSError if it does not run."""
        connected = socket.socket(socket.AF_UNIX)
        try:
            connected.settimeout(_HELLO_S)
            connected.connect(str(self.path))
        except OSError:
            connected.close()
            raise
        return connected

    def start(self) -> None:
        """Start the server in the background, unless it was just started. If one is already
        running, the new one ends at once. Raises ConfigurationError: it cannot be started.
        """
        now_s = time.monotonic()
        if now_s - self._started_s < _AGAIN_S:
            return
        self._started_s = now_s
        try:
            process = spawn(self._options, self.path, str(self._options.idle_s))
            assert process.stdin is not None
            with suppress(BrokenPipeError):
                process.stdin.close()
            code = process.wait(_SPAWN_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ConfigurationError(
                f"The server of the shared model cannot be started: {error}."
            ) from error
        if code:
            lines = self.path.with_suffix(".log").read_text(errors="replace").splitlines()
            said = lines[-1] if lines else "it printed nothing"
            raise ConfigurationError(f"The server of the shared model cannot be started: {said}.")
