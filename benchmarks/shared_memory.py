"""The shared-memory repair for a control plane that is assembled without a server."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

from rn_standard.fastdds.feature import SharedMemoryRepair
from rn_standard.fastdds.plugin import FEATURE
from roboneuron.supervisor.supervisor import Supervisor


@contextmanager
def repaired(supervisor: Supervisor) -> Iterator[None]:
    """Repair shared memory as a server with rn-fastdds installed does."""
    repair = SharedMemoryRepair(None)
    if FEATURE.on_join is not None:
        supervisor.on_join += (FEATURE.on_join,)
    assert supervisor.link
    repair.start(cast(Any, SimpleNamespace(modules=supervisor)))
    try:
        yield
    finally:
        repair.close()
