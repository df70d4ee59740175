"""Shared-memory files that Fast DDS leaves behind when a process is killed: found while it lives, removed afterwards.

A participant holds an exclusive flock on `<name>_el` for each segment and port it owns (measured: /proc/locks shows one
FLOCK WRITE for each; readers hold none). So the `_el` files that a process has open name what is its own, and a lock
that can be taken after its death proves that nobody else has taken the name over.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
_PREFIX, _SUFFIX = "fastrtps_", "_el"


def owned_segments(pid: int) -> frozenset[str]:
    """Names of the segments and ports that the living process `pid` owns; empty when it cannot be looked at."""
    names = set()
    with suppress(OSError):
        for entry in os.scandir(f"/proc/{pid}/fd"):
            with suppress(OSError):
                target = Path(os.readlink(entry.path))
                if target.parent == SHARED_MEMORY and target.name.startswith(_PREFIX) and target.name.endswith(_SUFFIX):
                    names.add(target.name.removesuffix(_SUFFIX))
    return frozenset(names)


def remove_stale(names: frozenset[str]) -> int:
    """Remove those segments whose owner is dead; returns how many were removed."""
    return sum(_remove_if_stale(name) for name in names)


def _remove_if_stale(name: str) -> bool:
    lock_file = SHARED_MEMORY / f"{name}{_SUFFIX}"
    try:
        descriptor = os.open(lock_file, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    else:
        for path in (SHARED_MEMORY / name, SHARED_MEMORY / f"sem.{name}_mutex", lock_file):
            path.unlink(missing_ok=True)
        return True
    finally:
        os.close(descriptor)
