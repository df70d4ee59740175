"""Unique node names per machine: two nodes of one name would both obey each request.

The ROS graph shows a second node only after its discovery, which takes a moment on a busy machine.
A process therefore claims its node name with a Unix socket in Linux' abstract namespace, named
after the ROS domain and the node. The socket needs no file, is visible to every user of the machine
(of its network namespace, like ROS' loopback traffic), and disappears with the process, however it
ends.

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
"""Length of the queue: connections of querying processes are never accepted, and stay until the
process ends.
"""
_RETRY_S = 0.05
"""Retry period: a name becomes free with its holder's death, without a notification."""
LEAVE_S = 3.0
"""Wait for modules of a server that has ended; they exit within 2 s."""


def claim(node: str, wait_s: float = 0.0) -> socket.socket:
    """Claim `node` for as long as the returned socket is open.

    Args:
        node: fully qualified name, `/<namespace>/<name>`.
        wait_s: time for the present holder to exit [s].

    Raises:
        StateError: another process of this machine runs the node; the message names it.
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
    """Process id of the holder of `node`; 0 if unknown (another container), None without a
    holder.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(_address(node))
        except BlockingIOError:  # queried very often: its queue is full
            return 0
        except ConnectionRefusedError:
            return None
        credentials = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(credentials)[0])


def runs_already(node: str, pid: int | str) -> StateError:
    """Create the error for a node that another process runs; a `pid` of 0 is unknown."""
    return StateError(
        f"{node} runs already, as {f'process {pid}' if pid else 'a process'} of another server.",
        hint="Stop that server, or give this one another [robot] namespace or ROS_DOMAIN_ID.",
    )


def _address(node: str) -> bytes:
    return f"\0roboneuron/{os.environ.get('ROS_DOMAIN_ID') or '0'}{node}".encode()
