"""Origin of recordings, and repair of those that were cut off."""

from __future__ import annotations

from pathlib import Path

from mcap.records import Header
from mcap.writer import MCAP0_MAGIC

from rn_recorder_runs.files import (
    LIBRARY,
    copy_records,
    is_finished,
    read_about,
    whole_records,
)


def read_origin(path: Path) -> str:
    """Which program wrote a file, for a person; empty if it is no MCAP file, or only its beginning.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        for entry in whole_records(file):
            if isinstance(entry, Header):
                return f"profile {entry.profile[:40]!r}, library {entry.library[:60]!r}"
            break
    return ""


def is_foreign(path: Path) -> bool:
    """True for a file that this program has not begun: of another program, or no recording.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        begins = file.read(len(MCAP0_MAGIC))
    if not MCAP0_MAGIC.startswith(begins):
        return True
    origin = read_origin(path)
    return bool(origin) and LIBRARY not in origin


def repair(path: Path) -> bool:
    """Add an index to a truncated file; return True if it needed one. A foreign file is left as it
    is.

    Raises:
        OSError: it cannot be written.
    """
    if is_finished(path) or is_foreign(path):
        return False
    copy_records([path], path, {**read_about(path), "repaired": "true"})
    return True
