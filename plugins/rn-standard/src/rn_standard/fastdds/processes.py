"""Shared memory of module processes: noted while they live, repaired and removed when they have
ended.
"""

from __future__ import annotations

import logging
import threading
import time

from rn_standard.fastdds.dead_ports import LEASE_S, SilentPorts, release_dead_locks
from rn_standard.fastdds.segments import owned_segments
from rn_standard.fastdds.shared_memory import SegmentRecord, remove_stale

log = logging.getLogger(__name__)
_RECENT = 10
"""The ports of this many ended processes are kept silent until their lease ends: port numbers come
again after 15.
"""


class ProcessCleaner:
    """A listener of `roboneuron.supervisor.process.ProcessEvents`; callable from any thread.

    Args:
        record: names what is owned, for the next server if this one is killed.
    """

    def __init__(self, record: SegmentRecord) -> None:
        self._record = record
        self._lock = threading.Lock()
        self._owned: dict[int, frozenset[str]] = {}
        self._ended: list[tuple[float, SilentPorts]] = []

    def spawning(self) -> None:
        """Close the ports of the dead before their numbers are used again, and release what
        strangers' dead hold.

        Those are not observed, and whoever opens such a port hangs there: a process that starts
        opens all it hears of.
        """
        release_dead_locks()
        now_s = time.monotonic()
        with self._lock:
            oldest = len(self._ended) - _RECENT
            kept = []
            for index, (ended_s, ports) in enumerate(self._ended):
                if index < oldest or now_s - ended_s >= LEASE_S:
                    ports.retire()
                else:
                    kept.append((ended_s, ports))
            self._ended = kept

    def observe(self, pid: int) -> None:
        """Remember which shared-memory files the process owns, in case it has no time to remove
        them itself.
        """
        names = owned_segments(pid)
        with self._lock:
            known = self._owned.get(pid, frozenset())
            self._owned[pid] = known | names
        self._record.add(names - known)

    def ended(self, pid: int, name: str) -> None:
        """Release its locks, silence its ports, remove its files."""
        with self._lock:
            names = self._owned.pop(pid, frozenset())
        release_dead_locks()
        ports = SilentPorts(names)
        with self._lock:
            self._ended.append((time.monotonic(), ports))
        removed = remove_stale(names)
        if removed:
            log.info(
                "Removed %d shared-memory files that %s (pid %d) left behind.", removed, name, pid
            )

    def close(self) -> None:
        """Close all ports of the dead; idempotent."""
        with self._lock:
            for _, ports in self._ended:
                ports.retire()
            self._ended = []
