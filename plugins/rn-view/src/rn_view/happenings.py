"""What happened, for the list on the page: tool calls, faults, changes of health, decisions of the gate."""

from __future__ import annotations

import json
import os
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

_KEPT = 300
_MOST_TEXT = 300
_FIRST_BYTES = 16_384
"""So much of the end of an audit is read when somebody begins to look."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Happening:
    """One line of the list.

    Attributes:
        at_s: wall-clock time [s].
        what: "tool", "fault", "health", "gate" or "stop".
        text: a sentence.
        is_bad: it is shown in red.
    """

    at_s: float
    what: str
    text: str
    is_bad: bool = False


class Happenings:
    """The newest happenings; usable from any thread."""

    def __init__(self, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._kept: deque[Happening] = deque(maxlen=_KEPT)
        self.count = 0
        """How many there were; tells whether there is news."""

    def add(self, what: str, text: str, *, is_bad: bool = False, at_s: float | None = None) -> None:
        """Add one that happened now, or at `at_s`."""
        text = text if len(text) <= _MOST_TEXT else f"{text[: _MOST_TEXT - 4]} ..."
        at_s = self._clock() if at_s is None else at_s
        with self._lock:
            self._kept.append(Happening(at_s=at_s, what=what, text=text, is_bad=is_bad))
            self.count += 1

    def newest(self, most: int) -> list[Happening]:
        """The newest ones, newest first."""
        with self._lock:
            return sorted(self._kept, key=lambda happening: happening.at_s, reverse=True)[:most]


class ToolCalls:
    """Middleware of the MCP server: adds each tool call when it begins and when it ends."""

    def __init__(self, happenings: Happenings) -> None:
        self._happenings = happenings

    async def __call__(self, ctx: Any, call_next: Callable[[Any], Awaitable[Any]]) -> Any:
        """See `mcp.server.context.ServerMiddleware`."""
        if ctx.method != "tools/call" or not ctx.params:
            return await call_next(ctx)
        call = f"{ctx.params.get('name')}({_arguments(ctx.params.get('arguments'))})"
        self._happenings.add("tool", f"{call} ...")
        begun_s = time.monotonic()
        try:
            result = await call_next(ctx)
        except BaseException as error:
            self._happenings.add("tool", f"{call}: {type(error).__name__}", is_bad=True)
            raise
        took = f"{time.monotonic() - begun_s:.2f} s"
        failure = failure_of(result)
        self._happenings.add("tool", f"{call}: {failure or 'done'}, {took}", is_bad=bool(failure))
        return result


def failure_of(result: Any) -> str:
    """The text of a failed call; empty when it did not fail."""
    if not getattr(result, "is_error", False):
        return ""
    return " ".join(block.text for block in result.content if hasattr(block, "text")) or "failed"


def _arguments(arguments: object) -> str:
    if not isinstance(arguments, dict) or not arguments:
        return ""
    return ", ".join(f"{key}={json.dumps(value, default=str)[:60]}" for key, value in list(arguments.items())[:8])


class AuditTail:
    """New records of an audit that other processes write, across its rotations. For one thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: BinaryIO | None = None
        self._rest = b""

    def read_new(self) -> list[dict[str, Any]]:
        """Records since the last time; the end of the file the first time. Empty when there is no file."""
        data, rest = b"", self._rest
        if self._file is None:
            self._open(-_FIRST_BYTES)
        if self._file is not None:
            data = self._file.read()
            if self._is_replaced():
                self._open(0)
                data += self._file.read()
        *lines, self._rest = (rest + data).split(b"\n")
        return [record for line in lines if (record := _record(line)) is not None]

    def close(self) -> None:
        """Read its end again the next time."""
        if self._file is not None:
            self._file.close()
        self._file, self._rest = None, b""

    def _open(self, offset: int) -> None:
        self.close()
        try:
            self._file = self._path.open("rb")
        except OSError:
            return
        size = os.fstat(self._file.fileno()).st_size
        self._file.seek(max(0, size + offset) if offset < 0 else 0)

    def _is_replaced(self) -> bool:
        assert self._file is not None
        try:
            there, ours = self._path.stat(), os.fstat(self._file.fileno())
        except OSError:
            return False
        return (there.st_dev, there.st_ino) != (ours.st_dev, ours.st_ino)


def _record(line: bytes) -> dict[str, Any] | None:
    """A record; None for the first part of a line, and for what is none."""
    try:
        record = json.loads(line)
    except ValueError:
        return None
    return record if isinstance(record, dict) and "verdict" in record else None


def add_record(happenings: Happenings, record: dict[str, Any]) -> None:
    """Add a record of the audit."""
    parts = [str(record.get("verdict", "")), str(record.get("tool", "")), str(record.get("endpoint", ""))]
    text = " ".join(part for part in parts if part)
    text += f", {record['who']}" if record.get("who") else ""
    text += f": {record['reason']}" if record.get("reason") else ""
    is_bad = record.get("verdict") in ("refused", "latched", "held", "lapsed")
    happenings.add("gate", text, is_bad=is_bad, at_s=float(record.get("time_ns", 0)) / 1e9)
