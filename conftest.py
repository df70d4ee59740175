"""What every test leaves as it found it."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="module")
def _pauses_of_the_interpreter() -> Iterator[None]:
    """Modules and servers freeze what they have loaded, since they live as long as their process; tests do not.

    Frozen ROS contexts are never collected: they keep their sockets, threads and shared memory.
    """
    interval_s = sys.getswitchinterval()
    yield
    sys.setswitchinterval(interval_s)
    gc.unfreeze()
    gc.collect()
