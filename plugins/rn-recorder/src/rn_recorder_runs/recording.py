"""Storage of recorded messages: a ring of the last seconds, recordings, and incidents.

It is independent of ROS. Everything is called from one thread, except that a separate thread
extracts incidents from the ring. If the disk cannot be written, messages are lost and counted; it
is tried again every two seconds.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from rn_recorder_runs.files import Record, write_json
from rn_recorder_runs.incident import OpenIncident, cut, to_incident
from rn_recorder_runs.repairing import repair
from rn_recorder_runs.sink import Latched, Sink
from rn_recorder_runs.store import RUN_FILE, RunStore, read_facts
from roboneuron import (
    ForeignDataError,
    StateError,
    foreign,
)

log = logging.getLogger(__name__)
SEGMENT_S = 5.0
"""Length of one file of the ring."""
_CHECK_S = 1.0
_MOST_BYTES = 1 << 22


@dataclass(frozen=True, kw_only=True, slots=True)
class Rules:
    """Settings of `[recorder]` for files.

    Attributes:
        ring_s: length of the ring [s]; 0 for no ring and no incidents.
        after_s: time of an incident after the fault [s].
        part_bytes, part_s: maximum size and duration of a part of a recording.
        quota_bytes: maximum size of all files together.
        keep_s: age of the last write after which files are deleted [s]; 0 for never.
        incident_s: maximum duration of a continuing incident, after which another one begins [s].
        min_free_bytes: free space on the disk below which writing ends.
    """

    ring_s: float = 30.0
    after_s: float = 5.0
    part_bytes: int = 500_000_000
    part_s: float = 300.0
    quota_bytes: int = 10_000_000_000
    min_free_bytes: int = 500_000_000
    keep_s: float = 0.0
    incident_s: float = 300.0


@dataclass(slots=True)
class _Active:
    """The recording in progress."""

    id: str
    folder: Path
    facts: dict[str, object]
    sink: Sink
    parts: int = 0


class Recording:
    """Ring, recordings and incidents of one recorder.

    Args:
        store: its directory is created with the first message.
        rules: sizes and times.
        about: metadata of every file.
        clock_ns: wall clock [ns].
        monotonic: monotonic time [s].
    """

    def __init__(
        self,
        store: RunStore,
        rules: Rules,
        about: Mapping[str, str],
        clock_ns: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self.store = store
        self.rules = rules
        self.incidents_written: list[str] = []
        self._about = dict(about)
        self._clock_ns = clock_ns
        self._monotonic = monotonic
        self._ring: deque[Path] = deque()
        self._segment = 0
        self.latched = Latched()
        """Metadata of topics and messages of latched ones, for every new file."""
        self._ring_sink = Sink("ring", self._next_segment, self._about, self.latched)
        self._active: _Active | None = None
        self._incident: OpenIncident | None = None
        self._former: OpenIncident | None = None
        """The newest written incident, to which a fault soon after it belongs."""
        self._cutting: threading.Thread | None = None
        self._checked_s = 0.0
        self._space = ""
        self.lost_space = 0

    @property
    def active_id(self) -> str:
        """Id of the recording in progress; empty for none."""
        return self._active.id if self._active is not None else ""

    def adopt(self) -> None:
        """Adopt the files of a dead recorder: index them, write its incident. Raises OSError."""
        self.store.make()
        left = sorted(self.store.ring.glob("*.mcap"))
        for path in self.store.ring.glob("*.json"):
            try:
                incident = to_incident(foreign.read_json(path, most_bytes=_MOST_BYTES))
            except ForeignDataError as error:  # the recording goes on without it
                log.error("An incident of an earlier recorder is lost: %s.", error)
                continue
            self._cut(incident, left)
        for run in self.store.runs():
            for path in run.files:
                repair(path)
            if run.facts.get("state") == "recording":
                write_json(
                    self.store.recordings / run.id / RUN_FILE, {**run.facts, "state": "interrupted"}
                )
        for path in left:
            path.unlink(missing_ok=True)

    def take(self, record: Record) -> None:
        """Store a message."""
        now_s = self._monotonic()
        self.latched.note(record)
        if self._space:
            self.lost_space += 1
            return
        if self.rules.ring_s > 0:
            self._ring_sink.write(record, now_s)
        if self._active is not None:
            self._active.sink.write(record, now_s)

    def tick(self) -> None:
        """Flush, rotate, delete old files, finish incidents; to be called several times a
        second.
        """
        now_s, now_ns = self._monotonic(), self._clock_ns()
        self._ring_sink.flush(now_s)
        file = self._ring_sink.file
        if file is not None and now_ns - file.first_ns > SEGMENT_S * 1e9 and file.messages:
            self._ring_sink.finish()
        if self._active is not None:
            sink = self._active.sink
            sink.flush(now_s)
            if sink.file is not None and sink.file.messages:
                is_long = now_ns - sink.file.first_ns > self.rules.part_s * 1e9
                if is_long or sink.file.size_bytes > self.rules.part_bytes:
                    sink.finish()
        if self._incident is not None and now_ns >= self._incident.due_ns(
            self.rules.ring_s, self.rules.after_s
        ):
            self._finish_incident()
        if now_s - self._checked_s >= _CHECK_S:
            self._checked_s = now_s
            self._thin_ring(now_ns)
            self._check_space()

    def start(self, name: str, facts: Mapping[str, object], *, resumed: str = "") -> str:
        """Start a recording and return its id; `resumed`: continue that one.

        Raises:
            StateError: another one is in progress, or the directory cannot be written.
        """
        if self._active is not None:
            raise StateError(
                f"The recording {self._active.id} is in progress.",
                hint="Call stop_recording first.",
            )
        run_id = resumed or f"{_stamp(self._clock_ns())}-{name}"
        folder = self.store.recordings / run_id
        try:
            folder.mkdir(mode=0o750, parents=True, exist_ok=True)
            known: dict[str, object] = {}
            if resumed:
                with suppress(OSError, ForeignDataError):
                    known = foreign.table(read_facts(folder), RUN_FILE)
            begun = {
                "name": name,
                "begun_ns": self._clock_ns(),
                "state": "recording",
                **dict(facts),
                **known,
            }
            begun["state"] = "recording"
            write_json(folder / RUN_FILE, begun)
        except OSError as error:
            raise StateError(
                f"The recording cannot be written to {folder}: {error.strerror or error}.",
                hint="Free disk space or mend the permissions; [recorder] directory names the "
                "place.",
            ) from error
        parts = len(list(folder.glob("part-*.mcap")))
        about = {**self._about, "run": run_id, "name": name}
        sink = Sink("recording", lambda: self._next_part(), about, self.latched)
        self._active = _Active(run_id, folder, begun, sink, parts)
        return run_id

    def stop(self, facts: Mapping[str, object], state: str = "finished") -> dict[str, object]:
        """End the recording and return its facts. Raises StateError without one."""
        active, self._active = self._active, None
        if active is None:
            raise StateError("No recording is in progress.", hint="start_recording begins one.")
        active.sink.finish()
        known = {
            **active.facts,
            **facts,
            "state": state,
            "ended_ns": self._clock_ns(),
            "lost_to_disk": active.sink.lost,
        }
        try:
            write_json(active.folder / RUN_FILE, known)
        except OSError as error:
            log.error("%s cannot be written: %s", active.folder / RUN_FILE, error)
        files = sorted(active.folder.glob("part-*.mcap"))
        return {
            **known,
            "id": active.id,
            "files": [str(path) for path in files],
            "directory": str(active.folder),
        }

    def incident(self, word: str, facts: Mapping[str, object]) -> str:
        """Handle a fault: keep the ring's time before it and some time after it.

        Another fault within that time, or so soon after it that the ring reaches back to it, joins
        the incident: a long series of faults is one file.
        """
        if self.rules.ring_s <= 0:
            return ""
        now_ns = self._clock_ns()
        until_ns = now_ns + round(self.rules.after_s * 1e9)
        most_ns = round(self.rules.incident_s * 1e9)
        if self._incident is not None and now_ns > self._incident.at_ns + most_ns:
            self._finish_incident()
        if self._incident is None:
            self._incident = self._reopened(now_ns) or OpenIncident(
                f"{_stamp(now_ns)}-{word}", now_ns, until_ns
            )
        pending = self._incident
        pending.until_ns = min(until_ns, pending.at_ns + most_ns)
        pending.facts.append({"at_ns": now_ns, "what": word, **facts})
        with suppress(OSError):  # for the next recorder, in case this one dies before it is written
            self.store.make()
            kept = {
                name: getattr(pending, name)
                for name in ("id", "at_ns", "until_ns", "facts", "kept_ns")
            }
            write_json(self.store.ring / f"{pending.id}.json", kept)
        return pending.id

    def _reopened(self, now_ns: int) -> OpenIncident | None:
        """The newest written incident, if this fault follows soon and it is not too long yet."""
        former, self._former = self._former, None
        if former is None or now_ns > former.until_ns + round(
            (self.rules.ring_s - self.rules.after_s) * 1e9
        ):
            return None
        if now_ns >= former.at_ns + round(self.rules.incident_s * 1e9):
            return None
        if self._cutting is not None:
            self._cutting.join()
        former.kept_ns = former.until_ns
        return former

    def close(self, state: str = "finished") -> None:
        """End the recording, a pending incident, and the ring."""
        if self._active is not None:
            self.stop({}, state)
        if self._incident is not None:
            self._finish_incident()
        if self._cutting is not None:
            self._cutting.join()
        self._ring_sink.finish()

    def state(self) -> dict[str, object]:
        """State for list_recordings and the log."""
        active = self._active
        problem = (
            self._space
            or self._ring_sink.problem
            or (active.sink.problem if active is not None else "")
        )
        file = active.sink.file if active is not None else None
        return {
            "recording": self.active_id,
            "problem": problem,
            "lost_to_disk": (active.sink.lost if active is not None else 0)
            + self.lost_space
            + self._ring_sink.lost,
            "part_bytes": file.size_bytes if file is not None else 0,
        }

    def _next_segment(self) -> Path:
        self._segment += 1
        path = self.store.ring / f"{self._clock_ns()}-{self._segment:06d}.mcap"
        self._ring.append(path)
        return path

    def _next_part(self) -> Path:
        assert self._active is not None
        self._active.parts += 1
        return self._active.folder / f"part-{self._active.parts:04d}.mcap"

    def _thin_ring(self, now_ns: int) -> None:
        """Delete segments that ended before the ring begins; those of an incident in progress are
        kept.
        """
        if self._cutting is not None and self._cutting.is_alive():
            return
        oldest_ns = now_ns - round(self.rules.ring_s * 1e9)
        if self._incident is not None:
            oldest_ns = min(oldest_ns, self._incident.begin_ns(self.rules.ring_s))
        while len(self._ring) > 1 and int(self._ring[1].name.split("-")[0]) < oldest_ns:
            self._ring.popleft().unlink(missing_ok=True)

    def _finish_incident(self) -> None:
        """Extract the incident from the ring on another thread, so that recording continues; a
        continuing one stays open.
        """
        incident, self._incident = self._incident, None
        assert incident is not None
        if self._cutting is not None:
            self._cutting.join()
        self._ring_sink.finish()
        now_ns = self._clock_ns()
        written = replace(
            incident, until_ns=min(incident.until_ns, now_ns), facts=list(incident.facts)
        )
        if incident.until_ns > now_ns:
            incident.kept_ns = now_ns
            self._incident = incident
        else:
            self._former = incident
        self._cutting = threading.Thread(
            target=self._cut, args=(written, list(self._ring)), name="incident"
        )
        self._cutting.start()

    def _cut(self, incident: OpenIncident, segments: list[Path]) -> None:
        is_new = not incident.kept_ns
        if cut(incident, segments, self.store, self.rules.ring_s, self._about) and is_new:
            self.incidents_written.append(incident.id)

    def _check_space(self) -> None:
        """End the parts before the disk is full, so that they have an index."""
        try:
            free = shutil.disk_usage(self.store.directory).free
        except OSError:
            return
        before = self._space
        self._space = ""
        if free < self.rules.min_free_bytes:
            self._space = (
                f"{free // 10**6} MB are free on the disk, min_free_mb is "
                f"{self.rules.min_free_bytes // 10**6}"
            )
            if not before:
                log.error("Recording pauses: %s.", self._space)
                self._ring_sink.finish()
                if self._active is not None:
                    self._active.sink.finish()
        sinks = [self._ring_sink, *([self._active.sink] if self._active is not None else [])]
        in_use = {sink.file.path for sink in sinks if sink.file is not None}
        for path in self.store.keep_below(self.rules.quota_bytes, in_use):
            log.info("Deleted for the quota: %s", path)
        if self.rules.keep_s > 0:
            for path in self.store.keep_younger(self._clock_ns() / 1e9 - self.rules.keep_s, in_use):
                log.info("Deleted for its age: %s", path)


def _stamp(at_ns: int) -> str:
    """Format a sortable time, for names."""
    at = datetime.fromtimestamp(at_ns / 1e9, UTC)
    return f"{at:%Y%m%dT%H%M%S}.{at.microsecond // 1000:03d}Z"
