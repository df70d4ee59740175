"""Shared-memory files that Fast DDS leaves behind when a process is killed: identified while it
lives, removed afterwards.

The owner holds a lock on `<name>_el` (see `segments.py`). If the lock can be taken after the
owner's death, no other process has reused the name.
"""

from __future__ import annotations

import fcntl
import logging
import os
import re
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from rn_standard.fastdds.segments import LOCK_SUFFIX, PREFIX, SHARED_MEMORY
from roboneuron.feature import log_files

log = logging.getLogger(__name__)
_NAME = re.compile(r"^fastrtps_[A-Za-z0-9]+$", re.MULTILINE)
_SEGMENT = re.compile(r"^fastrtps_([0-9a-f]{16}|port\d+)$")
LEAST_AGE_S = 60.0
"""Minimum age of removed segments: one is created, locked and mapped in steps, so a young one may
be incomplete.
"""
RECORD_NAME = "shared_memory"
"""Name of the record in a server run's log folder."""


def remove_stale(names: frozenset[str]) -> int:
    """Remove those segments whose owner is dead; return their number."""
    return sum(_remove_if_stale(name) for name in names)


def clean_abandoned(
    directory: Path = SHARED_MEMORY, least_age_s: float = LEAST_AGE_S
) -> tuple[int, int]:
    """Remove this user's files whose owners were killed, of any program; return their number and
    size [bytes].

    Only files that are at least `least_age_s` old, unlocked and mapped by no living process. Ports
    matter most: their names are reused, and a process that opens a dead one waits for its listener.
    """
    files = directory.glob(f"{PREFIX}*")
    names = {p.name.removesuffix(LOCK_SUFFIX) for p in files if _is_old(p, least_age_s)}
    if not names:
        return 0, 0  # the scan of all processes takes 30 ms and would delay the start
    removed = size = 0
    for name in names - _mapped(directory):
        with suppress(OSError):
            segment = directory / name
            held = segment.stat().st_size if segment.exists() else 0
            has_lock = (directory / f"{name}{LOCK_SUFFIX}").exists()
            if _remove_if_stale(name, directory) if has_lock else _remove(name, directory):
                removed, size = removed + 1, size + held
    return removed, size


def _is_old(path: Path, least_age_s: float) -> bool:
    """True for a segment or lock of this user that is at least that old [s]."""
    try:
        found = path.stat()
    except OSError:
        return False
    is_mine = found.st_uid == os.getuid() and time.time() - found.st_mtime >= least_age_s
    return is_mine and bool(_SEGMENT.match(path.name.removesuffix(LOCK_SUFFIX)))


def _mapped(directory: Path) -> set[str]:
    """Names of files in the directory that a living, accessible process maps."""
    names = set()
    for entry in os.scandir("/proc"):
        if entry.name.isdigit():
            with suppress(OSError):
                text = Path(f"/proc/{entry.name}/maps").read_text(
                    encoding="utf-8", errors="replace"
                )
                names |= {
                    line.rpartition("/")[2]
                    for line in text.splitlines()
                    if f" {directory}/{PREFIX}" in line
                }
    return names


def _remove_if_stale(name: str, directory: Path = SHARED_MEMORY) -> bool:
    lock_file = directory / f"{name}{LOCK_SUFFIX}"
    try:
        descriptor = os.open(lock_file, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    else:
        return _remove(name, directory)
    finally:
        os.close(descriptor)


def _remove(name: str, directory: Path) -> bool:
    for file in (name, f"sem.{name}_mutex", f"{name}{LOCK_SUFFIX}", f"{name}_sl"):
        (directory / file).unlink(missing_ok=True)
    return True


class SegmentRecord:
    """A file that names the segments of a server and its modules, so that the next server can clean
    up after a kill.

    Args:
        path: one file for each server run; created with the first name, removed by `close`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()

    def add(self, names: frozenset[str]) -> None:
        """Add names; if the disk cannot be written, only the cleanup after a kill is missing."""
        with self._lock:
            try:
                with open(self._path, "a", encoding="ascii", opener=log_files.opener) as file:
                    file.writelines(f"{name}\n" for name in sorted(names))
            except OSError as error:
                log.warning("The names of shared-memory files cannot be recorded: %s", error)

    def close(self) -> None:
        """Remove stale segments and the file, after an orderly end."""
        with self._lock:
            _clean(self._path)


def clean_recorded(records: Iterable[Path]) -> int:
    """Remove the stale segments of ended servers, and their records; return the number of segments.

    Args:
        records: files of `SegmentRecord`, in folders whose names end in "-<pid>".
    """
    return sum(
        _clean(record) for record in records if not _is_alive(record.parent.name.rpartition("-")[2])
    )


def _clean(record: Path) -> int:
    """Remove the stale segments of one record; the others belong to living processes."""
    try:
        names = frozenset(_NAME.findall(record.read_text(encoding="ascii")))
    except (OSError, UnicodeDecodeError):
        return 0
    removed = remove_stale(names)
    with suppress(OSError):
        record.unlink()
    return removed


def _is_alive(pid: str) -> bool:
    return Path(f"/proc/{pid}").exists()
