"""Process at the other end of a loopback connection."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

_TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
"""Columns 2, 3 and 10: local and remote address as HEX:PORT, inode of the socket. Source:
proc_pid_net(5).
"""


def peer_process(peer_port: int, own_port: int) -> int | None:
    """Process id of the owner of the local socket from `peer_port` to `own_port`; None if
    invisible.

    Takes milliseconds: it searches the descriptors of every process of this user.
    """
    inodes = set(_inodes(peer_port, own_port))
    for folder in Path("/proc").iterdir() if inodes else ():
        if folder.name.isdigit():
            with suppress(OSError), os.scandir(folder / "fd") as entries:
                for entry in entries:
                    with suppress(OSError):
                        if os.readlink(entry.path) in inodes:
                            return int(folder.name)
    return None


def _inodes(peer_port: int, own_port: int) -> list[str]:
    wanted = (f":{peer_port:04X}", f":{own_port:04X}")
    found = []
    for table in _TABLES:
        with suppress(OSError):
            for line in table.read_text(encoding="ascii").splitlines()[1:]:
                columns = line.split()
                if (
                    columns[1].endswith(wanted[0])
                    and columns[2].endswith(wanted[1])
                    and columns[9] != "0"
                ):
                    found.append(f"socket:[{columns[9]}]")
    return found
