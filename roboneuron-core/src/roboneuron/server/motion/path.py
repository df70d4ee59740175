"""The direct path put together: the gate, who moves which robot, and what features are lent of them."""

from __future__ import annotations

import logging
import time

from roboneuron.gate import Gate
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.motion.allow_list import AllowList
from roboneuron.server.motion.arbiter import MotionArbiter
from roboneuron.server.motion.exposed import Exposed
from roboneuron.server.motion.gate import MotionGate
from roboneuron.server.motion.traffic import Traffic
from roboneuron.supervisor.supervisor import Supervisor

log = logging.getLogger(__name__)
_CLOSE_S = 2.0


class DirectPath:
    """Motion beside the closed loop. Usable from any thread.

    Attributes:
        gate: what everything passes.
        arbiter: who moves which robot.
        allow_list: what agents may use.
        lent: what features get of all that.
    """

    def __init__(self, loop: ClosedLoop) -> None:
        """Args:
        loop: the closed loop beside it; its policy has the robot while it runs, its emergency stop and audit are used.
        """
        self._loop = loop
        supervisor: Supervisor = loop.supervisor
        server = loop.config.server
        self.gate = Gate(
            (),
            latch=loop.emergency_stop.file,
            audit=loop.emergency_stop.audit,
            clock=time.monotonic,
            dry_run=server.dry_run,
        )
        self.arbiter = MotionArbiter(self.gate, self._policy)
        self.allow_list = AllowList(self.gate, lambda: loop.config, loop.plugins.current)
        traffic = Traffic(lambda: supervisor.link)
        self.lent = MotionGate(self.gate, self.arbiter, traffic, self.allow_list, server.max_duration_s)

    def close(self) -> None:
        """End every motion with its stop message; idempotent."""
        if not self.arbiter.end_all("The server is shutting down.", _CLOSE_S):
            log.error("A motion did not end within %g s.", _CLOSE_S)
        self.gate.audit.close()

    def _policy(self, exposed: Exposed) -> str:
        """Who else moves the robot, as a sentence."""
        view = self._loop.supervisor.view("inference")
        if view.phase not in ("starting", "running") or view.choice is None:
            return ""
        if view.choice.settings.config.namespace != exposed.namespace:
            return ""
        return f"The policy {view.choice.names.get('backend', '')!r} moves {exposed.robot!r}."
