"""The feature: cleanup at the start, monitoring of module processes, and of the server's
own ports.
"""

from __future__ import annotations

import logging
import os

from rn_standard.fastdds.lost_ports import PortWatch
from rn_standard.fastdds.processes import ProcessCleaner
from rn_standard.fastdds.segments import owned_segments
from rn_standard.fastdds.shared_memory import (
    RECORD_NAME,
    SegmentRecord,
    clean_abandoned,
    clean_recorded,
)
from roboneuron import Feature, Host

log = logging.getLogger(__name__)


class SharedMemoryRepair(Feature[None]):
    """Keeps senders from blocking on killed processes, and removes their shared memory."""

    _cleaner: ProcessCleaner | None = None
    _record: SegmentRecord | None = None
    _ports: PortWatch | None = None

    def start(self, host: Host) -> None:
        """Clean up after killed servers and programs, and start monitoring module processes."""
        directory = host.modules.log_directory
        clean_recorded(directory.parent.glob(f"*/{RECORD_NAME}"))
        removed, size = clean_abandoned()
        if removed:
            log.info(
                "Removed %d shared-memory files (%.0f MB) of processes that were killed.",
                removed,
                size / 1e6,
            )
        self._record = SegmentRecord(directory / RECORD_NAME)
        self._record.add(owned_segments(os.getpid()))
        self._cleaner = ProcessCleaner(self._record)
        events = host.modules.process_events
        events.spawning.listen(self._cleaner.spawning)
        events.seen.listen(self._cleaner.observe)
        events.ended.listen(self._cleaner.ended)
        self._ports = PortWatch()
        self._ports.start()

    def close(self) -> None:
        """Close the ports of ended modules and remove the rest of their files."""
        if self._ports is not None:
            self._ports.close()
        if self._cleaner is not None and self._record is not None:
            self._cleaner.close()
            self._record.close()
