"""Other servers that use the same state directory: known by a lock that ends with its process,
whatever ends that.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path

from roboneuron.feature import log_files

FOLDER = "servers"
"""In the state directory: an empty file for each server, called as its process id and locked by it.
"""


class ServerPresence:
    """The lock of this process; `open` takes it, `close` gives it back."""

    def __init__(self, state_directory: Path) -> None:
        self._folder = state_directory / FOLDER
        self._path = self._folder / str(os.getpid())
        self._held: int | None = None

    def open(self) -> list[int]:
        """Take the lock, and return the process ids of the servers that hold theirs; files of dead
        ones go.

        A directory that cannot be written costs the knowledge, nothing else.
        """
        with suppress(OSError):
            self._held = self._lock(self._path)
        return sorted(
            int(path.name) for path in self._folder.glob("[0-9]*") if self._is_of_another(path)
        )

    def close(self) -> None:
        """Give the lock back; idempotent."""
        held, self._held = self._held, None
        if held is not None:
            self._path.unlink(missing_ok=True)
            os.close(held)

    def _lock(self, path: Path) -> int | None:
        """A descriptor that holds the lock of a file; None when another holds it."""
        descriptor = log_files.opener(str(path), os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        return descriptor

    def _is_of_another(self, path: Path) -> bool:
        if path == self._path:
            return False
        with suppress(OSError):
            descriptor = self._lock(path)
            if descriptor is None:
                return True
            path.unlink(missing_ok=True)
            os.close(descriptor)
        return False
