"""New lines of the audit file: verdicts of the gate, emergency stops, limits of control."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from roboneuron import ForeignDataError, foreign

_MOST = 1 << 20


class AuditTail:
    """Follows the file from its present end, also across rotations. Used from one thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = -1
        self._rest = b""
        self._open(from_end=True)

    def lines(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Lines since the last call, with their parsed content."""
        yield from self._new()
        with suppress(OSError):
            there = os.stat(self._path)
            if self._descriptor < 0 or os.fstat(self._descriptor).st_ino != there.st_ino:
                self.close()
                self._open(from_end=False)
                yield from self._new()

    def close(self) -> None:
        """Close the file."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _open(self, *, from_end: bool) -> None:
        with suppress(OSError):
            self._descriptor = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
            self._rest = b""
            if from_end:
                os.lseek(self._descriptor, 0, os.SEEK_END)

    def _new(self) -> Iterator[tuple[str, dict[str, Any]]]:
        while self._descriptor >= 0:
            data = os.read(self._descriptor, _MOST)
            if not data:
                return
            *whole, self._rest = (self._rest + data).split(b"\n")
            for line in whole:
                with suppress(ForeignDataError):
                    entry = foreign.decode_json(line, "a line of the audit")
                    if isinstance(entry, dict):
                        yield line.decode("utf-8", errors="replace"), entry
