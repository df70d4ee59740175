"""Notification of a switch between the first policy and its fallback."""

from __future__ import annotations

from collections.abc import Callable

from roboneuron.modules.inference.execution import ACTING, COUNT, REASON
from roboneuron.supervisor.changes import Periodic
from roboneuron.supervisor.health import Modules

_LOOK_S = 0.2


class FallbackWatch(Periodic):
    """Check five times a second which of two policies acts, see `inference.fallback`.

    Args:
        modules: modules of the server.
        tell: called with a word for the event and an explanation.
    """

    def __init__(self, modules: Modules, tell: Callable[[str, str], object]) -> None:
        super().__init__("fallback", _LOOK_S, self.look)
        self._modules = modules
        self._tell = tell
        self._count = "0"
        self._is_over = True

    def look(self) -> None:
        """Compare with the previous check."""
        report = self._modules.view("inference").report
        metrics = {} if report is None else report.metrics
        acting = metrics.get(ACTING)
        if acting is None:  # no such module, or no fallback: the next one counts anew
            self._count, self._is_over = "0", True
            return
        count, reason = metrics[COUNT], metrics[REASON]
        if count != self._count:
            self._tell("fallback", f"{acting} acts: {reason}")
            self._is_over = False
        if not reason and not self._is_over:
            self._tell("fallback_over", f"{acting} answers in time, and acts again")
            self._is_over = True
        self._count = count
