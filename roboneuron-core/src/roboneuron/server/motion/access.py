"""What direct motion consists of, for the parts of this package."""

from __future__ import annotations

from dataclasses import dataclass

from roboneuron.errors import RefusedError
from roboneuron.gate import Gate, GateRequest, Verdict
from roboneuron.server.motion.arbiter import MotionArbiter
from roboneuron.server.motion.exposed import Exposed
from roboneuron.server.motion.traffic import Traffic


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Access:
    """The gate, who moves which robot, and the publishers and clients; never handed to a feature."""

    gate: Gate
    arbiter: MotionArbiter
    traffic: Traffic

    def ask(self, exposed: Exposed, request: GateRequest) -> Verdict:
        """The answer to a dry run: may it be done now, and if not, by which rule."""
        try:
            self.arbiter.check_free(exposed)
        except RefusedError as error:
            return Verdict(allowed=False, dry_run=True, reason=str(error), rule="ownership")
        return self.gate.check(request)
