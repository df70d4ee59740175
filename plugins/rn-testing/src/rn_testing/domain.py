"""ROS domains for tests: those of test runs side by side on one machine never meet."""

from __future__ import annotations

import fcntl
import os
import random
import tempfile
from collections import deque
from pathlib import Path

DOMAINS = range(30, 101)
"""Domains whose ports stay below Linux' ephemeral ports. Source: docs.ros.org, "The ROS_DOMAIN_ID".
"""

_POOL = 6
"""Domains one process takes turns with, so that what an ended test left on the graph is not met by
the next one.
"""

_held: deque[int] = deque()


def free_ros_domain() -> int:
    """A ROS domain that no other process which asked this function holds; it is given back when
    this process ends.

    Raises:
        RuntimeError: every domain is taken; the text says which file to look at.
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
        f"Every ROS domain of {DOMAINS} is held by another test process. Look who locks {folder}/*."
    )
