"""Audit log: one JSON line per decision, rotated by size. Motion is refused while it cannot be
written.
"""

from __future__ import annotations

import contextlib
import errno
import getpass
import json
import logging
import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from pydantic_core import to_json

from roboneuron.errors import RefusedError
from roboneuron.gate.stillness import StillReason
from roboneuron.log_files import locked, make_log_directory

_MAX_ARGUMENTS = 4096
"""Characters of a call's arguments that are kept: an agent may send a megabyte."""
log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class AuditRecord:
    """One decision of the gate, of control's limits or of the emergency stop.

    Attributes:
        who, role: the client.
        tool, robot, endpoint: the called tool, its robot and its endpoint.
        arguments: as sent by the client, truncated.
        verdict: "allowed", "refused", "would_allow" or "would_refuse" (simulated); "scaled" or
            "held" (control); "latched" or "restored" (emergency stop); "cut" (the previous line is
            incomplete).
        rule, reason: the limit or rule that applied, and a sentence with the numbers.
        clamped: values that were changed, as "path: asked -> sent".
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


_CUT = AuditRecord(
    who="audit",
    role="",
    tool="",
    verdict="cut",
    rule="audit",
    reason="The line before was cut short and is no record.",
)
"""Written after an incomplete line, left by a power failure or a killed process."""


class AuditLog:
    """Append-only file of records, shared by several processes. Thread-safe. The constructor does
    not open the file.

    A record is one `write` to a file opened with O_APPEND: the kernel appends atomically, so that
    processes need no lock except for a rotation.

    Attributes:
        path: the current file.
        on_record: called with each written record, on the writer's thread; must return quickly.
        failure: why nothing may move since the last record could not be written; None if it was
            written. A motion in progress has to end.
    """

    @staticmethod
    def user_at_terminal() -> str:
        """Name of this process's user for records, also of one without an entry in passwd (as in a
        container).
        """
        try:
            name = getpass.getuser()
        except (KeyError, OSError):
            name = f"user {os.getuid()}"
        return f"{name} at the command line"

    @classmethod
    def in_directory(cls, state: Path, clock_ns: Callable[[], int] = time.time_ns) -> AuditLog:
        """Create the log of a state directory with the system clock; rotated files end in .1, .2
        and so on.
        """
        return cls(state / "audit.jsonl", clock_ns)

    def __init__(
        self,
        path: Path,
        clock_ns: Callable[[], int],
        *,
        max_bytes: int = 10_000_000,
        backups: int = 5,
    ) -> None:
        """Args:
        path: the current file; its directory is created with the first record.
        clock_ns: wall-clock time [ns].
        max_bytes: size at which the file is rotated.
        backups: how many rotated files are kept, at least 1.
        """
        self.path = path
        self.on_record: Callable[[AuditRecord], object] = lambda record: None
        self._clock_ns = clock_ns
        self._max_bytes = max_bytes
        self._backups = max(1, backups)
        # guards the fields below; `on_record` is called without it, so that a listener may write
        # too
        self._lock = threading.RLock()
        self._descriptor = -1
        self._identity = (-1, -1)
        # the file ends within a line: an appended record would be lost in it
        self._torn = False
        self.failure: StillReason | None = None

    def write(self, record: AuditRecord) -> None:
        """Append a record; it is then with the operating system, not necessarily on the disk.

        Raises:
            RefusedError: it cannot be written; motion is refused.
        """
        line = self._to_line(record)
        with self._lock:
            try:
                self._append(line)
            except OSError as error:
                self.failure = StillReason(
                    rank="server",
                    rule="audit",
                    message=f"The audit {self.path} cannot be written: {error.strerror or error}. "
                    "Nothing moves without it.",
                    hint="Free disk space or fix the permissions of the state directory.",
                )
                self.close()
                raise self.failure.refusal() from error
            self.failure = None
        self.on_record(record)

    def write_if_possible(self, record: AuditRecord) -> None:
        """Append a record of an event that must not depend on it, such as an emergency stop; a
        failure is logged.
        """
        try:
            self.write(record)
        except RefusedError as error:
            log.error(
                "%s by %s (%s) is not in the audit: %s",
                record.tool,
                record.who,
                record.verdict,
                error,
            )

    def close(self) -> None:
        """Close the file; the next record reopens it."""
        with self._lock:
            if self._descriptor >= 0:
                with contextlib.suppress(OSError):
                    os.close(self._descriptor)
                self._descriptor = -1

    def _append(self, line: bytes) -> None:
        """Append a line. Raises OSError if it is not written completely."""
        if self._open() + len(line) > self._max_bytes:
            self._rotate(len(line))
        if self._torn:
            line = b"\n" + self._to_line(_CUT) + line
        written = os.write(self._descriptor, line)
        # a full disk accepts a part: removed again, so that no partial record is read as a decision
        if written != len(line):
            end = os.lseek(self._descriptor, 0, os.SEEK_CUR)
            if os.fstat(self._descriptor).st_size == end:  # no other process has appended since
                os.ftruncate(self._descriptor, end - written)
            raise OSError(errno.ENOSPC, "only a part of the record was written")
        self._torn = False

    def _open(self) -> int:
        """Open the current file; reopen it after it was rotated or deleted by another process.

        Returns its size. Each record delays an agent's call, so the check of an open file is one
        system call: the device and inode of the descriptor are cached.
        """
        if self._descriptor >= 0:
            with contextlib.suppress(FileNotFoundError):
                there = os.stat(self.path)
                if (there.st_dev, there.st_ino) == self._identity:
                    return there.st_size
            self.close()
        make_log_directory(self.path.parent)
        self._descriptor = os.open(
            self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o640
        )
        found = os.fstat(self._descriptor)
        self._identity = found.st_dev, found.st_ino
        size = found.st_size
        self._torn = size > 0 and os.pread(self._descriptor, 1, size - 1) != b"\n"
        return size

    def _rotate(self, coming: int) -> None:
        """Rotate the files, and open the new one.

        Args:
            coming: number of bytes to be appended.
        """
        # Checked again under the lock: another process may have rotated the files meanwhile.
        with locked(self.path):
            if self.path.exists() and self.path.stat().st_size + coming > self._max_bytes:
                numbers = range(self._backups, 0, -1)
                rotated = [self.path.with_name(f"{self.path.name}.{number}") for number in numbers]
                for older, newer in pairwise([*rotated, self.path]):
                    if newer.exists():
                        newer.replace(older)
        self._open()

    def _to_line(self, record: AuditRecord) -> bytes:
        """Format a record as one line of ASCII; empty fields are left out."""
        now_ns = self._clock_ns()
        at_s, rest_ns = divmod(now_ns, 1_000_000_000)
        parts = [
            f'"time":"{_second(at_s)}.{rest_ns // 1_000_000:03d}+00:00"',
            f'"time_ns":{now_ns}',
        ]
        # field by field, so that the arguments, its largest part, are encoded only once
        for name in record.__dataclass_fields__:
            value = getattr(record, name)
            if value:
                text = _bounded(value) if name == "arguments" else _JSON.encode(value)
                parts.append(f'"{name}":{text}')
        return f"{{{','.join(parts)}}}\n".encode("ascii")


@lru_cache(maxsize=1)
def _second(at_s: int) -> str:
    """Format a second of wall-clock time as ISO 8601, UTC, without an offset. Cached, because an
    agent in motion makes many records per second.
    """
    return datetime.fromtimestamp(at_s, UTC).replace(tzinfo=None).isoformat()


# created once: creating one costs as much as writing a record
_JSON = json.JSONEncoder(separators=(",", ":"))


def _bounded(arguments: Mapping[str, Any]) -> str:
    """Encode the arguments as standard JSON, truncated, or the reason why they cannot be serialised
    (a cycle, or too deep nesting).
    """
    try:
        # ten times as fast as the encoder above; a NaN, which JSON lacks, becomes text
        text = to_json(
            arguments, inf_nan_mode="strings", fallback=lambda value: f"<{type(value).__name__}>"
        ).decode()
        if not text.isascii():
            text = _JSON.encode(json.loads(text))
    except (ValueError, TypeError, RecursionError) as error:
        return _JSON.encode({"unwritable": type(error).__name__})
    if len(text) > _MAX_ARGUMENTS:
        return _JSON.encode({"length": len(text), "begins": text[:_MAX_ARGUMENTS]})
    return text
