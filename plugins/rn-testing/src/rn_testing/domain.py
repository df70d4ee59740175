"""ROS domains for tests, so that concurrent test runs on one machine never meet."""

from __future__ import annotations

import fcntl
import os
import random
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
    process ends.

    Raises:
        RuntimeError: all domains are taken; the text names the lock files.
    """
    if len(_held) == _POOL:
        _held.rotate(-1)
        return _held[-1]
    folder = Path(tempfile.gettempdir()) / f"roboneuron-domains-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    for domain in random.SystemRandom().sample(DOMAINS, len(DOMAINS)):
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
