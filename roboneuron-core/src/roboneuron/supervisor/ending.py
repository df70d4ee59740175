"""How module processes are silenced and ended: asked first, with a bound on everything, killed when they do not go."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from roboneuron.errors import NotReadyError, RoboNeuronError
from roboneuron.modules.settings import ModuleSettings
from roboneuron.supervisor.changes import Changes
from roboneuron.supervisor.lifecycle import LifecycleClient
from roboneuron.supervisor.process import ModuleProcess
from roboneuron.supervisor.slot import Slot

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink

log = logging.getLogger(__name__)
DEACTIVATE_S = 2.0
KILL_S = 5.0
"""After SIGKILL the kernel needs no more than this, unless the process hangs in a driver."""


def deactivate(
    link: RosLink, changes: Changes, slot: Slot, settings: ModuleSettings, most_s: float = DEACTIVATE_S
) -> None:
    """Ask for silence, for at most `most_s`; what does not answer is ended anyway."""
    limit_s = min(most_s, settings.config.supervisor.stop_timeout_s / 2)
    if slot.process is None:
        return
    client = LifecycleClient(
        link,
        f"/{settings.status_name}",
        changes,
        lambda: slot.check_alive("being deactivated"),
        slot.process.announce,
    )
    try:
        if client.transition("deactivate", limit_s) is None:
            log.warning("%s did not answer `deactivate` within %.1f s.", settings.node_name, limit_s)
    except RoboNeuronError as error:
        log.warning("Deactivating %s: %s", settings.node_name, error)


def end_processes(processes: Sequence[ModuleProcess], timeout_s: float) -> set[int]:
    """SIGTERM, bounded wait, SIGKILL, reap; returns the pids that had to be killed.

    Raises:
        NotReadyError: one survives SIGKILL.
    """
    for process in processes:
        process.show()
        process.terminate()
    deadline_s = time.monotonic() + timeout_s
    killed = set()
    for process in processes:
        if not process.wait(max(0.0, deadline_s - time.monotonic())):
            log.warning("%s (pid %d) did not leave within %g s: killed.", process.name, process.pid, timeout_s)
            process.kill()
            killed.add(process.pid)
    for process in processes:
        if not process.wait(KILL_S):
            raise NotReadyError(f"{process.name} (pid {process.pid}) survives SIGKILL: it hangs in the kernel.")
    return killed
