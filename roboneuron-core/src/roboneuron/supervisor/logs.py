"""One log file for each module of each server run, and their last lines."""

from __future__ import annotations

import os
import time
from pathlib import Path

_TAIL_BYTES = 64 * 1024


def run_directory(state_directory: Path) -> Path:
    """`<state>/log/<time>-<pid>`: where this server's modules log; not created yet."""
    return state_directory / "log" / f"{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"


def read_tail(path: Path, *, lines: int, offset: int = 0) -> tuple[str, ...]:
    """The last `lines` lines after byte `offset`, of at most the last 64 KiB; empty when there is no such file."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            start = max(offset, size - _TAIL_BYTES)
            file.seek(start)
            text = file.read().decode("utf-8", errors="replace")
    except FileNotFoundError:
        return ()
    found = text.splitlines()
    if start > offset and len(found) > 1:
        found = found[1:]
    return tuple(found[-lines:])
