"""One process per node name and machine: two nodes of one name would both obey each request.

The ROS graph shows a second one only once it has been discovered, which takes a moment on a busy
machine. A process therefore holds a Unix socket in Linux' abstract namespace, named after the ROS
domain and the node: it needs no file, is seen by every user of the machine (of its network
namespace, as ROS' loopback traffic is), and is gone with the process, however that ends.

Source: unix(7), "Abstract sockets" and SO_PEERCRED.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import time

from roboneuron.errors import StateError

_CREDENTIALS = struct.Struct("3i")
"""struct ucred: pid, uid, gid."""
_QUEUE = 4096
"""Nobody takes up the connections of those who ask; they lie here until the process ends."""
_RETRY_S = 0.05
"""A name becomes free with the death of its holder, which tells nobody."""
LEAVE_S = 3.0
"""The modules of a server that has ended leave within 2 s."""


def claim(node: str, wait_s: float = 0.0) -> socket.socket:
    """Hold `node` for as long as the socket that is returned is open.

    Args:
        node: fully qualified name, `/<namespace>/<name>`.
        wait_s: how long whoever holds it now is given to leave.

    Raises:
        StateError: another process of this machine runs the node; the text tells which one.
    """
    deadline_s = time.monotonic() + wait_s
    while True:
        held = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            held.bind(_address(node))
            held.listen(_QUEUE)
        except OSError as error:
            held.close()
            if error.errno != errno.EADDRINUSE:
                raise
            if time.monotonic() >= deadline_s:
                raise runs_already(node, claimant(node) or 0) from error
            time.sleep(_RETRY_S)
        else:
            return held


def claimant(node: str) -> int | None:
    """Process id of who holds `node`; 0 when it cannot be told (another container), None when
    nobody does.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(_address(node))
        except BlockingIOError:  # asked very often: its queue is full
            return 0
        except ConnectionRefusedError:
            return None
        credentials = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(credentials)[0])


def runs_already(node: str, pid: int | str) -> StateError:
    """The error for a node that somebody else runs; a `pid` of 0 is not known."""
    who = f"process {pid}" if pid else "a process"
    return StateError(
        f"{node} runs already, as {who} of another server.",
        hint="Stop that server, or give this one another [robot] namespace or ROS_DOMAIN_ID.",
    )


def _address(node: str) -> bytes:
    return f"\0roboneuron/{os.environ.get('ROS_DOMAIN_ID') or '0'}{node}".encode()
