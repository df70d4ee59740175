"""The server of a model on this machine, which the first robot starts."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

from rn_backend_openpi.options import PolicyOptions
from roboneuron import ConfigurationError

_HELLO_S = 0.5
_SPAWN_S = 60.0
_AGAIN_S = 2.0
"""Shortest time between two starts of the same server."""


def directory_of(options: PolicyOptions) -> Path:
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


class LocalServer:
    """The server of a model at a Unix socket.

    Args:
        options: the model.

    Attributes:
        path: path of the socket; the log is next to it.
    """

    def __init__(self, options: PolicyOptions) -> None:
        self._options = options
        self.path = directory_of(options) / f"{options.identity()}.sock"
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
        running, the new one ends at once.
        """
        now_s = time.monotonic()
        if now_s - self._started_s < _AGAIN_S:
            return
        self._started_s = now_s
        python = str(self._options.python or sys.executable)
        try:
            subprocess.run(
                [
                    *(python, "-P", "-m", "rn_backend_openpi.server_process"),
                    *(str(self._options.idle_s), str(self.path)),
                ],
                input=self._options.of_the_model().model_dump_json(exclude_unset=True) + "\n",
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
