"""What all derived tools share."""

from __future__ import annotations

from dataclasses import dataclass

from roboneuron.gate import Gate
from roboneuron.server.direct.motion import MotionDesk
from roboneuron.server.direct.traffic import Traffic


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Access:
    """The ways to a robot.

    Attributes:
        gate: what everything passes.
        desk: who moves which robot.
        traffic: publishers, subscriptions, clients.
        max_duration_s: longest motion, sequence, goal or wait.
    """

    gate: Gate
    desk: MotionDesk
    traffic: Traffic
    max_duration_s: float
