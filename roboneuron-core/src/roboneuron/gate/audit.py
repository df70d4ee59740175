"""The audit: one JSON line per decision, rotated by size, closed to motion when it cannot be written."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from roboneuron.errors import RefusedError
from roboneuron.log_files import make_log_directory

FILE_NAME = "audit.jsonl"
"""Name of the newest file in the state directory; older ones end in .1, .2 ..."""
_MAX_ARGUMENTS = 4096


@dataclass(frozen=True, kw_only=True, slots=True)
class AuditRecord:
    """One decision.

    Attributes:
        who, role: the client.
        tool, robot, endpoint: what was asked for.
        arguments: as the agent sent them; cut when long.
        verdict: "allowed", "refused", "would_allow" or "would_refuse" (dry run), "latched".
        rule, reason: why not.
        clamped: what was changed.
    """

    who: str
    role: str
    tool: str
    verdict: str
    robot: str = ""
    endpoint: str = ""
    rule: str = ""
    reason: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    clamped: tuple[str, ...] = ()


class AuditLog:
    """Appends records to a file; several processes may share it. Safe from any thread. Construction touches nothing."""

    def __init__(
        self, path: Path, clock_ns: Callable[[], int], *, max_bytes: int = 10_000_000, backups: int = 5
    ) -> None:
        """Args:
        path: the newest file; its directory is created with the first record.
        clock_ns: wall-clock time [ns].
        max_bytes: size after which a new file is begun.
        backups: how many older files are kept, at least 1.
        """
        self.path = path
        self._clock_ns = clock_ns
        self._max_bytes = max_bytes
        self._backups = max(1, backups)
        self._lock = threading.Lock()
        self._descriptor = -1
        self._torn = False
        self._failed = False

    @property
    def failed(self) -> bool:
        """Whether the last record could not be written; motion that is under way has to end then."""
        return self._failed

    def write(self, record: AuditRecord) -> None:
        """Append a record; it is with the operating system when this returns, not necessarily on the disk.

        Raises:
            RefusedError: it cannot be written.
        """
        line = self._to_line(record)
        with self._lock:
            try:
                self._append(line)
            except OSError as error:
                self._failed = True
                self._close()
                raise RefusedError(
                    f"The audit {self.path} cannot be written: {error.strerror or error}. Nothing moves without it.",
                    hint="Free disk space or mend the permissions of the state directory.",
                ) from error
            self._failed = False

    def close(self) -> None:
        """Close the file; a later record opens it again."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._descriptor >= 0:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = -1

    def _append(self, line: bytes) -> None:
        self._open()
        if os.fstat(self._descriptor).st_size + len(line) > self._max_bytes:
            self._rotate(len(line))
        if self._torn:
            line = b"\n" + line
        written = os.write(self._descriptor, line)
        self._torn = written != len(line)
        if self._torn:
            raise OSError(28, "only a part of the record fitted")

    def _open(self) -> None:
        """Open the newest file, again when it was moved or deleted meanwhile."""
        if self._descriptor >= 0:
            with contextlib.suppress(FileNotFoundError):
                ours, there = os.fstat(self._descriptor), os.stat(self.path)
                if (ours.st_dev, ours.st_ino) == (there.st_dev, there.st_ino):
                    return
            self._close()
        make_log_directory(self.path.parent)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
        self._descriptor = os.open(self.path, flags, 0o640)

    def _rotate(self, coming: int) -> None:
        """Begin a new file; the lock keeps two processes from rotating at once."""
        with _locked(self.path.with_name(self.path.name + ".lock")):
            if self.path.exists() and self.path.stat().st_size + coming > self._max_bytes:
                for number in range(self._backups, 0, -1):
                    older = self.path.with_name(f"{self.path.name}.{number}")
                    newer = self.path if number == 1 else self.path.with_name(f"{self.path.name}.{number - 1}")
                    if newer.exists():
                        newer.replace(older)
                self._torn = False
        self._open()

    def _to_line(self, record: AuditRecord) -> bytes:
        now_ns = self._clock_ns()
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(now_ns / 1e9, UTC).isoformat(timespec="milliseconds"),
            "time_ns": now_ns,
            **{name: value for name, value in _fields(record) if value},
        }
        if "arguments" in entry:
            entry["arguments"] = _bounded(record.arguments)
        return json.dumps(entry, separators=(",", ":"), allow_nan=False).encode("ascii") + b"\n"


def _fields(record: AuditRecord) -> Iterator[tuple[str, Any]]:
    """The record's fields; unlike `asdict` it does not copy what is inside."""
    return ((name, getattr(record, name)) for name in record.__dataclass_fields__)


def _bounded(arguments: Mapping[str, Any]) -> Any:
    """The arguments, or their beginning when they are long, or the reason why they cannot be written."""
    try:
        text = json.dumps(arguments, separators=(",", ":"), default=_fallback)
        if len(text) > _MAX_ARGUMENTS:
            return {"length": len(text), "begins": text[:_MAX_ARGUMENTS]}
        return json.loads(text, parse_constant=str)  # JSON has no NaN
    except (ValueError, TypeError, RecursionError) as error:
        return {"unwritable": type(error).__name__}


def _fallback(value: Any) -> str:
    return f"<{type(value).__name__}>"


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o640)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
