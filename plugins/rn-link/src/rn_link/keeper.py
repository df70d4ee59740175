"""Supervision of this machine's relay, by every process that uses the link."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rn_link.environment import uses_link
from rn_link.machine import link_folder, read_machine
from rn_link.state import LOCK, STATE
from roboneuron import ConfigurationError
from roboneuron.feature import Periodic

if TYPE_CHECKING:
    from roboneuron.feature import ModuleHost  # imports rclpy

_LOOK_S = 0.5
"""Time after which another process replaces a relay whose process has ended."""


def keep_link(_: ModuleHost | None = None) -> None:
    """Keep the relay of this machine running until this process ends; called once per process."""
    if uses_link():
        RelayKeeper(link_folder()).start()


class RelayKeeper(Periodic):
    """Starts the relay if none runs, on its own thread from `start` to `close`.

    The relay ends with the process that started it; another process then starts a new one.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__("link-relay", _LOOK_S, self._look)
        self._folder = folder
        self._relay: subprocess.Popen[bytes] | None = None

    def close(self) -> None:
        """End the thread, and the relay if this process started it."""
        super().close()
        self._end_relay()

    def _end_relay(self) -> None:
        if self._relay is not None:
            self._relay.kill()
            # waits for it, and closes the pipe
            self._relay.communicate()
            self._relay = None

    def _look(self) -> None:
        if self._relay is not None and self._relay.poll() is None:
            return
        self._end_relay()
        try:
            if read_machine(self._folder) is None:
                return
        except ConfigurationError:  # reported by `join_link`
            return
        lock = os.open(self._folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            (self._folder / STATE).unlink(missing_ok=True)  # from the previous relay
            # the relay inherits the lock, and holds it until it ends
            self._relay = subprocess.Popen(
                [sys.executable, "-P", "-m", "roboneuron.hang_watch", "rn_link.relay"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                pass_fds=(lock,),
                start_new_session=True,
            )
        except BlockingIOError:
            return
        finally:
            os.close(lock)
