"""Directory of runs: recordings of several parts, incidents of one file, and the ring; listing,
quota, deletion.

<directory>/recordings/<id>/part-0001.mcap ... run.json <directory>/incidents/<id>.mcap
<directory>/ring/<number>.mcap
"""

from __future__ import annotations

import fcntl
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from roboneuron import (
    ForeignDataError,
    InvalidInputError,
    StateError,
    foreign,
)

log = logging.getLogger(__name__)
RUN_FILE = "run.json"
LABELS, WHOLE_RUN = "labels", "all"
"""Key of `Run.facts` for labels given by people, by episode, or for the whole run."""
LOCK = "recorder.lock"
"""Lock file of a recorder that uses the directory."""
Kind = Literal["recording", "incident"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """A recording or an incident on disk.

    Attributes:
        id: unique in its directory.
        files: its MCAP files, oldest first.
        facts: name, outcome, note ... of run.json, or the metadata of an incident's file.
    """

    id: str
    kind: Kind
    files: tuple[Path, ...]
    facts: dict[str, Any]

    @property
    def size_bytes(self) -> int:
        """Size of all its files."""
        sizes = 0
        for path in self.files:
            with suppress(OSError):
                sizes += path.stat().st_size
        return sizes

    @property
    def told(self) -> dict[str, str]:
        """Outcome and comment of the whole run, as labelled by people; else as recorded."""
        label: dict[str, str] = self.facts.get(LABELS, {}).get(WHOLE_RUN, {})
        comment = str(self.facts.get("note") or self.facts.get("incident") or "")
        return {"outcome": str(self.facts.get("outcome", "")), "comment": comment, **label}

    @property
    def is_complete(self) -> bool:
        """True if every file of it has an index."""
        from rn_recorder_runs.files import is_finished  # heavy

        return all(is_finished(path) for path in self.files)

    def span(self) -> tuple[int, int, int]:
        """First and last time [ns] and number of messages, of its files with an index."""
        from rn_recorder_runs.files import read_statistics  # heavy

        first, last, count = 0, 0, 0
        for path in self.files:
            statistics, _ = read_statistics(path)
            if statistics is not None and statistics.message_count:
                begin = statistics.message_start_time
                first = begin if not first else min(first, begin)
                last = max(last, statistics.message_end_time)
                count += statistics.message_count
        return first, last, count


class RunStore:
    """The directory of runs. Nothing is created before `make`."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.recordings = directory / "recordings"
        self.incidents = directory / "incidents"
        self.ring = directory / "ring"

    def make(self) -> None:
        """Create the folders. Raises OSError."""
        for folder in (self.directory, self.recordings, self.incidents, self.ring):
            folder.mkdir(mode=0o750, parents=True, exist_ok=True)

    def lock(self) -> int | None:
        """Lock the directory for one recorder and return the descriptor; None while another one
        uses it. Raises OSError.
        """
        descriptor = os.open(self.directory / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        return descriptor

    def runs(self) -> list[Run]:
        """All recordings and incidents, oldest first."""
        return sorted([*self._recordings(), *self._incidents()], key=lambda run: run.id)

    def get(self, name: str) -> Run:
        """The run of that id, or the newest for "latest".

        Raises:
            InvalidInputError: there is none, or several begin with the name.
        """
        runs = self.runs()
        if name == "latest" and runs:
            return runs[-1]
        found = [run for run in runs if run.id == name] or [
            run for run in runs if run.id.startswith(name)
        ]
        if len(found) != 1:
            known = ", ".join(run.id for run in runs[-5:]) or "none"
            raise InvalidInputError(
                f"{'Several runs begin' if found else 'No run begins'} with {name!r} in "
                f"{self.directory}.",
                hint=f"The newest are: {known}.",
                path="run",
            )
        return found[0]

    def repair(self) -> list[Path]:
        """Add an index to every truncated file, unless a recorder is running here; return those
        that needed it.
        """
        from rn_recorder_runs.repairing import repair  # heavy

        held = None
        with suppress(OSError):
            held = self.lock()
        if held is None:
            return []
        repaired = []
        try:
            for run in self.runs():
                for path in run.files:
                    try:
                        if repair(path):
                            repaired.append(path)
                    except OSError as error:
                        log.warning("%s was cut short and cannot be repaired: %s", path, error)
        finally:
            os.close(held)
        return repaired

    def delete(self, run: Run) -> None:
        """Delete a run.

        Raises:
            StateError: it is being written.
            OSError: it cannot be deleted.
        """
        if run.facts.get("state") == "recording" and self.is_in_use():
            raise StateError(
                f"The run {run.id} is being recorded.", hint="Call stop_recording first."
            )
        if run.kind == "incident":
            for path in run.files:
                path.unlink()
        else:
            shutil.rmtree(self.recordings / run.id)

    def label(
        self, run: Run, *, outcome: str | None, comment: str | None, episode: int | None = None
    ) -> dict[str, str]:
        """Store a person's label of a recording, or of one episode; it overrides earlier ones.
        Returns the whole label.

        Args:
            run: a run of this directory.
            outcome: "success", "failure" or "unknown"; None leaves it as it is.
            comment: any text; None leaves it as it is.
            episode: its number, from 0; None for the whole run.

        Raises:
            InvalidInputError: it is not a recording of this directory.
            StateError: it is being written, or cannot be.
        """
        from rn_recorder_runs.files import write_json  # heavy

        folder = self.recordings / run.id
        if run.kind != "recording" or not folder.is_dir():
            raise InvalidInputError(
                f"{run.id} is no recording in {self.directory}.",
                hint="`roboneuron runs list` names them.",
            )
        if run.facts.get("state") == "recording" and self.is_in_use():
            raise StateError(
                f"The run {run.id} is being recorded.", hint="Call stop_recording first."
            )
        told = {"outcome": outcome, "comment": comment}
        labels: dict[str, dict[str, str]] = dict(run.facts.get(LABELS, {}))
        key = WHOLE_RUN if episode is None else str(episode)
        labels[key] = {
            **labels.get(key, {}),
            **{name: text for name, text in told.items() if text is not None},
        }
        try:
            write_json(folder / RUN_FILE, {**run.facts, LABELS: labels})
        except OSError as error:
            raise StateError(
                f"{folder / RUN_FILE} cannot be written: {error.strerror or error}.",
                hint="Free space on that disk or mend the permissions.",
            ) from error
        return labels[key]

    def is_in_use(self) -> bool:
        """True if a recorder uses the directory."""
        try:
            held = self.lock()
        except OSError:
            return False
        if held is not None:
            os.close(held)
        return held is None

    def keep_below(self, quota_bytes: int, open_files: set[Path]) -> list[Path]:
        """Delete the oldest finished files, recordings before incidents, until the quota is met;
        return the deleted ones.

        The newest incident and `open_files` are kept.
        """
        deleted: list[Path] = []
        total = sum(_size(path) for path in self.directory.rglob("*.mcap"))
        incidents = sorted(self.incidents.glob("*.mcap"))[:-1]
        for path in [*sorted(self.recordings.glob("*/*.mcap")), *incidents]:
            if total <= quota_bytes:
                break
            if path in open_files:
                continue
            size = _size(path)
            with suppress(OSError):
                path.unlink()
                total -= size
                deleted.append(path)
                if path.parent.parent == self.recordings and not list(path.parent.glob("*.mcap")):
                    shutil.rmtree(path.parent, ignore_errors=True)
        return deleted

    def keep_younger(self, since_s: float, open_files: set[Path]) -> list[Path]:
        """Delete finished files that were last written before that time [s since 1970]; return the
        deleted ones.
        """
        deleted: list[Path] = []
        for path in [
            *sorted(self.recordings.glob("*/*.mcap")),
            *sorted(self.incidents.glob("*.mcap")),
        ]:
            with suppress(OSError):
                if path in open_files or path.stat().st_mtime >= since_s:
                    continue
                path.unlink()
                deleted.append(path)
                if path.parent.parent == self.recordings and not list(path.parent.glob("*.mcap")):
                    shutil.rmtree(path.parent, ignore_errors=True)
        return deleted

    def _recordings(self) -> Iterator[Run]:
        for folder in self.recordings.glob("*"):
            files = tuple(sorted(folder.glob("part-*.mcap")))
            facts: dict[str, object] = {}
            with suppress(OSError, ForeignDataError):
                facts = foreign.table(read_facts(folder), RUN_FILE)
            if files or facts:
                yield Run(id=folder.name, kind="recording", files=files, facts=facts)

    def _incidents(self) -> Iterator[Run]:
        from rn_recorder_runs.files import read_about  # heavy

        for path in self.incidents.glob("*.mcap"):
            with suppress(OSError):
                yield Run(
                    id=path.stem, kind="incident", files=(path,), facts=dict(read_about(path))
                )


def read_facts(folder: Path) -> Any:
    """The facts of a recording. Raises as `foreign.read_json`."""
    return foreign.read_json(folder / RUN_FILE, most_bytes=1 << 22, has_constants=True)


def decoded_event(text: str) -> dict[str, Any]:
    """A recorded event or prediction.

    Raises:
        ForeignDataError: another program has written it.
    """
    found = foreign.decode_json(text, "a recorded event", most_bytes=1 << 24, has_constants=True)
    return foreign.table(found, "a recorded event")


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
