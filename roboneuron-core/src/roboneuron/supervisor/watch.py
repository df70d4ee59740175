"""Watching modules: a word for how each one is, looked at so often that no fault stays unseen for half a second."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from typing import Literal

from roboneuron.supervisor.periodic import Periodic
from roboneuron.supervisor.view import ModuleView

log = logging.getLogger(__name__)
Health = Literal["stopped", "starting", "stopping", "ok", "waiting", "failing", "stalled", "stuck", "silent", "exited"]
FAULTS: frozenset[Health] = frozenset({"failing", "stalled", "stuck", "silent", "exited"})
SILENT_S = 0.42
"""A module reports every 0.2 s; without a report for this long it is frozen, or its machine is overloaded."""
STUCK_S = 0.3
"""A module's executor turns every 0.02 s; the age it reports grows for up to one period more."""
LOOK_S = 0.03
EXPLANATIONS: dict[Health, str] = {
    "stopped": "it does not run",
    "starting": "it is being started",
    "stopping": "it is being stopped",
    "ok": "it works",
    "waiting": "it runs, and something is missing",
    "failing": "it runs and reports an error",
    "stalled": "it reports, but its work makes no progress",
    "stuck": "it reports, but takes no messages and no requests",
    "silent": "its process exists and says nothing",
    "exited": "its process has ended by itself",
}


def assess(view: ModuleView, now_s: float) -> Health:
    """How a module is at the monotonic time `now_s`."""
    if view.phase != "running":
        return view.phase
    report = view.report
    if report is None or now_s - report.received_s > SILENT_S:
        return "silent"
    if report.loop_age_s is not None and report.loop_age_s > STUCK_S:
        return "stuck"
    age_s, limit_s = report.work_age_s, report.work_limit_s
    if age_s is not None and limit_s is not None and age_s > limit_s:
        return "stalled"
    if report.error_code:
        return "failing"
    return "ok" if report.ready else "waiting"


Listener = Callable[[ModuleView, Health, Health], None]
"""Called from the watching thread with the module, how it was, and how it is."""


class Watch(Periodic):
    """A thread that looks at all modules and tells listeners about every change.

    Args:
        views: the modules.
        listeners: called in this order; they must return quickly.
    """

    def __init__(self, views: Callable[[], Sequence[ModuleView]], listeners: Sequence[Listener]) -> None:
        super().__init__("watch", LOOK_S, self.look)
        self._views = views
        self._listeners = tuple(listeners)
        self._known: dict[str, Health] = {}

    def look(self) -> None:
        """Compare everything with what is known."""
        now_s = time.monotonic()
        for view in self._views():
            health, before = assess(view, now_s), self._known.get(view.kind, "stopped")
            if health == before:
                continue
            self._known[view.kind] = health
            level = logging.WARNING if health in FAULTS else logging.INFO
            log.log(level, "%s: %s (was %s): %s.", view.kind, health, before, EXPLANATIONS[health])
            for listener in self._listeners:
                try:
                    listener(view, before, health)
                except Exception:  # one failing listener must not keep the others from hearing of it
                    log.exception("A listener failed.")
