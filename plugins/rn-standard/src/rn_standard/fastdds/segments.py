"""Ownership of Fast DDS shared-memory files by living processes.

A participant holds an exclusive flock on `<name>_el` for each segment and port it owns (measured:
/proc/locks shows one FLOCK WRITE for each; readers hold none). So the open `_el` files of a process
identify its own files.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
PREFIX, LOCK_SUFFIX = "fastrtps_", "_el"
PORT_PREFIX = f"{PREFIX}port"


def port_number(name: str) -> int | None:
    """Port number of a file name; None if it is not a port's."""
    number = name.removeprefix(PORT_PREFIX)
    return int(number) if name.startswith(PORT_PREFIX) and number.isdecimal() else None


def owned_segments(pid: int) -> frozenset[str]:
    """Names of the segments and ports that the living process `pid` owns; empty if inaccessible."""
    names = set()
    with suppress(OSError):
        for entry in os.scandir(f"/proc/{pid}/fd"):
            with suppress(OSError):
                target = Path(os.readlink(entry.path))
                if (
                    target.parent == SHARED_MEMORY
                    and target.name.startswith(PREFIX)
                    and target.name.endswith(LOCK_SUFFIX)
                ):
                    names.add(target.name.removesuffix(LOCK_SUFFIX))
    return frozenset(names)
