"""Other servers that use the same state directory, detected by a lock that ends with its
process.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path

from roboneuron.feature import log_files

FOLDER = "servers"
"""Folder in the state directory with an empty file for each server, named by its process id and
locked by it.
"""


class ServerPresence:
    """Lock of this process; `open` takes it, `close` releases it."""

    def __init__(self, state_directory: Path) -> None:
        self._folder = state_directory / FOLDER
        self._path = self._folder / str(os.getpid())
        self._held: int | None = None

    def open(self) -> list[int]:
        """Take the lock, and return the process ids of other running servers; files of dead ones
        are removed.

        If the directory cannot be written, only this information is missing.
        """
        with suppress(OSError):
            self._held = self._lock(self._path)
        return sorted(
            int(path.name) for path in self._folder.glob("[0-9]*") if self._is_of_another(path)
        )

    def close(self) -> None:
        """Release the lock; idempotent."""
        held, self._held = self._held, None
        if held is not None:
            self._path.unlink(missing_ok=True)
            os.close(held)

    def _lock(self, path: Path) -> int | None:
        """Return a descriptor that holds the lock of a file; None if another process holds it."""
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
