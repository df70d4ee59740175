"""Incident records, one JSON file for each fault: kind, time, the module's last status and log, and
the last actions.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from roboneuron import ForeignDataError, foreign
from roboneuron.feature import log_files

log = logging.getLogger(__name__)
FOLDER = "incidents"
KEPT = 200
_MOST_BYTES = 1 << 24
_AGAIN_S = 5.0
"""Time within which the same recurring fault of the same module is one incident."""


class FaultSpans:
    """How long faults of modules have lasted while this server ran. Usable from any thread.

    Args:
        monotonic: time [s].
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._monotonic = monotonic
        # modules are watched, and asked for their faults, on different threads
        self._lock = threading.Lock()
        self._since: dict[tuple[str, str], float] = {}
        self._longest: dict[tuple[str, str], float] = {}

    def change(self, module: str, before: str, now: str) -> None:
        """Note that the health of a module has changed."""
        with self._lock:
            self._keep(module, before)
            self._since.pop((module, before), None)
            self._since[module, now] = self._monotonic()

    def longest_s(self, module: str, what: str) -> float | None:
        """Longest duration of a fault [s], the present one included; None if not known."""
        with self._lock:
            self._keep(module, what)
            return self._longest.get((module, what))

    def is_now(self, module: str, what: str) -> bool:
        """True if the module has that fault now."""
        return (module, what) in self._since

    def _keep(self, module: str, what: str) -> None:
        since_s = self._since.get((module, what))
        if since_s is not None:
            lasted_s = self._monotonic() - since_s
            self._longest[module, what] = max(self._longest.get((module, what), 0.0), lasted_s)


class Incidents:
    """Writes and lists the records; the newest 200 are kept. Usable from any thread.

    Args:
        directory: folder of the files; created with the first record.
        clock: wall-clock time [s], for the stamps.
        monotonic: time [s] for the detection of repetitions.
        robot: returns the present robot, real or simulated.

    Attributes:
        spans: how long faults lasted.
    """

    def __init__(
        self,
        directory: Path,
        clock: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
        robot: Callable[[], str] = lambda: "",
    ) -> None:
        self.directory, self.robot = directory, robot
        self.spans = FaultSpans(monotonic)
        self._clock = clock
        self._monotonic = monotonic
        self._lock = threading.Lock()
        self._newest: dict[tuple[str, str], tuple[float, Path]] = {}
        self._count = 0
        self._recent: deque[tuple[float, str]] = deque(maxlen=KEPT)

    def recent(self, within_s: float) -> tuple[int, list[str], float]:
        """Faults of the last seconds: their number, their modules, and the age of the newest."""
        now_s = self._monotonic()
        recent = [one for one in tuple(self._recent) if now_s - one[0] <= within_s]
        age_s = now_s - recent[-1][0] if recent else math.inf
        return len(recent), list(dict.fromkeys(module for _, module in recent)), age_s

    def record(self, module: str, what: str, facts: Mapping[str, object]) -> Path | None:
        """Write a record; return None if it repeats a recent one, or cannot be written (which is
        logged).
        """
        now_s, seen_s = self._clock(), self._monotonic()
        with self._lock:
            self._recent.append((seen_s, module))
            before_s, before = self._newest.get((module, what), (-math.inf, None))
            # a record that was removed meanwhile, as with its directory, tells nobody of this one
            if before is not None and seen_s - before_s < _AGAIN_S and before.exists():
                self._newest[module, what] = seen_s, before
                return None
            self._count += 1
            at = datetime.fromtimestamp(now_s, UTC)
            when = f"{at:%Y%m%dT%H%M%S}.{at.microsecond // 1000:03d}Z"
            name = f"{when}-{os.getpid()}-{self._count}-{module}-{what}.json"
            path = self.directory / name
            self._newest[module, what] = seen_s, path
        record = {
            "id": name.removesuffix(".json"),
            "at": at.isoformat(),
            "module": module,
            "what": what,
            "robot": self.robot(),
            **facts,
        }
        try:
            temporary = path.with_suffix(".part")
            with open(temporary, "w", encoding="utf-8", opener=log_files.opener) as file:
                json.dump(record, file, indent=1)
            temporary.replace(path)
            self._thin_out()
        except OSError as error:
            log.error("The incident %s cannot be recorded: %s", name, error)
            return None
        log.warning("Incident recorded: %s", path)
        return path

    def listing(self, most: int) -> list[dict[str, object]]:
        """The newest records, newest first."""
        found = []
        for path in self._files()[-most:][::-1]:
            try:
                found.append(foreign.read_json(path, most_bytes=_MOST_BYTES, has_constants=True))
            except (OSError, ForeignDataError) as error:
                log.warning("The incident record %s cannot be read: %s", path, error)
        return found

    def _files(self) -> Sequence[Path]:
        return sorted(self.directory.glob("*.json")) if self.directory.is_dir() else []

    def _thin_out(self) -> None:
        for path in self._files()[:-KEPT]:
            path.unlink(missing_ok=True)
