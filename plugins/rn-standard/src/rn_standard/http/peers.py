"""Process at the other end of a loopback connection."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from anyio import to_thread
from starlette.requests import HTTPConnection

from rn_standard.http.connections import PROTOCOL_KEY, BoundedProtocol

_TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
"""Columns 2, 3 and 10: local and remote address as HEX:PORT, inode of the socket. Source:
proc_pid_net(5).
"""


def protocol_of(conn: HTTPConnection) -> BoundedProtocol | None:
    """The connection of a request; None on another server than BoundedServer."""
    found = conn.scope.get("state", {}).get(PROTOCOL_KEY)
    return found if isinstance(found, BoundedProtocol) else None


async def process_of(conn: HTTPConnection) -> str:
    """ "pid 123" for the process at the other end of a loopback connection; empty if unknown."""
    protocol = protocol_of(conn)
    if protocol is None or conn.client is None:
        return ""
    if protocol.peer is None:
        own_port = int(conn.scope["server"][1])
        pid = await to_thread.run_sync(peer_process, conn.client.port, own_port)
        protocol.peer = f"pid {pid}" if pid else ""
    return protocol.peer


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
