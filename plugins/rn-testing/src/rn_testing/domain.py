"""ROS domains for tests, so that concurrent test runs on one machine never meet."""

from __future__ import annotations

import fcntl
import os
import random
import re
import tempfile
from collections import deque
from pathlib import Path

DOMAINS = range(30, 101)
"""Domains whose ports stay below Linux' ephemeral ports. Source: docs.ros.org, "The
ROS_DOMAIN_ID".
"""

_POOL = 6
"""Number of domains that one process uses in rotation, so that a test does not meet remains of an
earlier one on the graph.
"""

_held: deque[int] = deque()


def free_ros_domain() -> int:
    """Reserve a ROS domain among the processes that use this function; it is released when this
    process ends. None is taken in which a module still runs, as one that a killed test has left.

    Raises:
        RuntimeError: all domains are taken; the text names the lock files.
    """
    if len(_held) == _POOL:
        _held.rotate(-1)
        return _held[-1]
    folder = Path(tempfile.gettempdir()) / f"roboneuron-domains-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    in_use = _domains_in_use()
    for domain in random.SystemRandom().sample(DOMAINS, len(DOMAINS)):
        if domain in in_use:
            continue
        lock = os.open(folder / str(domain), os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            continue
        _held.append(domain)
        return domain
    if _held:
        _held.rotate(-1)
        return _held[-1]
    raise RuntimeError(
        f"Every ROS domain of {DOMAINS} is held by another test process. See which process "
        f"locks {folder}/*."
    )


def _domains_in_use() -> set[int]:
    """Domains in which a process of this machine has claimed the name of a node, by Linux' table
    of sockets. Source: proc(5), "/proc/net/unix"; the name is that of `roboneuron.ros.claim`.
    """
    table = Path("/proc/net/unix")
    sockets = table.read_text() if table.exists() else ""
    return {int(domain) for domain in re.findall(r"@roboneuron/(\d+)/", sockets)}
