"""Shared memory of module processes: recorded while they live, repaired and removed after their
end.
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
"""Number of ended processes whose ports stay silenced until their lease ends: port numbers repeat
after 15.
"""


class ProcessCleaner:
    """A listener of `roboneuron.supervisor.process.ProcessEvents`; callable from any thread.

    Args:
        record: stores the owned names, for the next server if this one is killed.
    """

    def __init__(self, record: SegmentRecord) -> None:
        self._record = record
        # guards what is known of living and ended processes; files are removed without it
        self._lock = threading.Lock()
        self._owned: dict[int, frozenset[str]] = {}
        self._ended: list[tuple[float, SilentPorts]] = []

    def spawning(self) -> None:
        """Close the ports of dead processes before their numbers are reused, and release the locks
        of dead foreign processes.

        Foreign processes are not observed, but a starting process opens every port it discovers,
        and would hang at such a lock.
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
        """Record the process's shared-memory files, in case it cannot remove them itself."""
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
        """Close all ports of dead processes; idempotent."""
        with self._lock:
            for _, ports in self._ended:
                ports.retire()
            self._ended = []
