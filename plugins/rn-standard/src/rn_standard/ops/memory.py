"""Per-module memory limit: a leaking plugin must not starve the processes that control the arm."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from weakref import WeakSet

from rn_standard.ops.options import MemoryOptions
from roboneuron.feature import ModuleKind, Modules, Periodic

log = logging.getLogger(__name__)
_LOOK_S = 0.05
GRACE_S = 0.5
"""Time between SIGTERM, upon which a module holds the robot, and SIGKILL."""
Record = Callable[[ModuleKind, str], None]
"""Called with the ended module and the reason."""


def own_memory_mb(pid: int) -> float | None:
    """Private memory of a process [MB]: resident, without files and shared memory; None after its
    end.

    Source: proc_pid_statm(5).
    """
    try:
        fields = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()
    except OSError:
        return None
    return (int(fields[1]) - int(fields[2])) * os.sysconf("SC_PAGE_SIZE") / 1e6


class MemoryWatch(Periodic):
    """Ends modules that use more memory than `[ops.memory_limit_mb]` allows; checks every 50 ms,
    starting modules included.

    Memory of a module's children (a served engine) is not counted, nor is that of a GPU.
    """

    def __init__(self, modules: Modules, limits: MemoryOptions, record: Record) -> None:
        super().__init__("memory", _LOOK_S, self.look)
        self._modules = modules
        self._limits = limits
        self._record = record
        self._ended: WeakSet[object] = WeakSet()

    def look(self) -> None:
        """Compare all modules with their limits."""
        for slot in self._modules.all_slots():
            kind, process = slot.kind, slot.process
            if process is None or process.exit_code is not None or process in self._ended:
                continue
            limit_mb = self._limits.limit_mb(kind)
            used_mb = own_memory_mb(process.pid) if limit_mb is not None else None
            if limit_mb is None or used_mb is None or used_mb <= limit_mb:
                continue
            why = (
                f"ended: it holds {used_mb:.0f} MB, [ops.memory_limit_mb] {kind} = {limit_mb} "
                "are allowed"
            )
            log.error("%s (pid %d) is %s.", kind, process.pid, why)
            self._ended.add(process)
            process.note(f"supervisor: {kind} is {why}.")
            process.terminate()
            ending = partial(_kill_late, process.wait, process.kill)
            threading.Thread(target=ending, name=f"end-{kind}", daemon=True).start()
            self._record(kind, why)


def _kill_late(wait: Callable[[float], bool], kill: Callable[[], object]) -> None:
    if not wait(GRACE_S):
        kill()
