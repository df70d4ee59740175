"""Which shared-memory files this server and its modules own, written down for the server that starts after a crash."""

from __future__ import annotations

import logging
import os
import threading
from contextlib import suppress
from pathlib import Path

from roboneuron.supervisor.shared_memory import owned_segments, remove_stale

log = logging.getLogger(__name__)
_PREFIX, _SUFFIX = "segments-", ".txt"


class Ledger:
    """One file in the state directory for each running server, named by its pid. Usable from any thread."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._path = directory / f"{_PREFIX}{os.getpid()}{_SUFFIX}"
        self._names: set[str] = set()
        self._lock = threading.Lock()

    def note(self, *pids: int) -> None:
        """Add what these processes own now; a disk that cannot be written to only costs the clean-up."""
        found = frozenset().union(*(owned_segments(pid) for pid in pids))
        with self._lock:
            if found <= self._names:
                return
            self._names |= found
            try:
                self._directory.mkdir(parents=True, exist_ok=True)
                self._path.write_text("\n".join(sorted(self._names)), encoding="ascii")
            except OSError as error:
                log.warning("Shared-memory files cannot be noted in %s: %s", self._path, error)

    def clean(self) -> int:
        """Remove what servers of this state directory left behind that are gone; returns how many files that were."""
        removed = 0
        for path in self._directory.glob(f"{_PREFIX}*{_SUFFIX}"):
            pid = path.name.removeprefix(_PREFIX).removesuffix(_SUFFIX)
            if path == self._path or Path(f"/proc/{pid}").exists():
                continue
            with suppress(OSError, UnicodeDecodeError):
                removed += remove_stale(frozenset(path.read_text(encoding="ascii").split()))
                path.unlink()
        if removed:
            log.warning("Removed %d shared-memory files that an earlier server left behind.", removed)
        return removed

    def close(self) -> None:
        """Everything was ended in order: nothing to clean for others, except what is still there."""
        with self._lock:
            remove_stale(frozenset(self._names))
            self._path.unlink(missing_ok=True)
