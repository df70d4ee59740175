"""Supervision of this machine's relay, by every process that brings one."""

from __future__ import annotations

import subprocess
import sys

from rn_link.environment import uses_link
from roboneuron.feature import Periodic

_LOOK_S = 0.5
"""Time after which a relay that has ended is replaced."""


def keep_link() -> None:
    """Keep the relay of this machine running until this process ends; called once per process."""
    if uses_link():
        RelayKeeper().start()


class RelayKeeper(Periodic):
    """A relay from `start` to `close`, which works while that of no other process does.

    It ends with this process; that of another process then takes its place.
    """

    def __init__(self) -> None:
        super().__init__("link-relay", _LOOK_S, self._look)
        self._relay: subprocess.Popen[bytes] | None = None

    def close(self) -> None:
        """End the thread and the relay."""
        super().close()
        self._end_relay()

    def _end_relay(self) -> None:
        if self._relay is not None:
            self._relay.kill()
            # waits for it, and closes the pipe
            self._relay.communicate()

    def _look(self) -> None:
        if self._relay is None or self._relay.poll() is not None:
            self._end_relay()
            words = [sys.executable, "-P", "-m", "roboneuron.hang_watch", "rn_link.relay"]
            self._relay = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True
            )
