"""Which shared-memory files of Fast DDS belong to a living process.

A participant holds an exclusive flock on `<name>_el` for each segment and port it owns (measured:
/proc/locks shows one FLOCK WRITE for each; readers hold none). So the `_el` files that a process
has open name what is its own.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
PREFIX, LOCK_SUFFIX = "fastrtps_", "_el"
PORT_PREFIX = f"{PREFIX}port"


def port_number(name: str) -> int | None:
    """Number of the port that a file of that name holds; None when it is no port's."""
    number = name.removeprefix(PORT_PREFIX)
    return int(number) if name.startswith(PORT_PREFIX) and number.isdecimal() else None


def owned_segments(pid: int) -> frozenset[str]:
    """Names of the segments and ports that the living process `pid` owns; empty when it cannot be
    looked at.
    """
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
