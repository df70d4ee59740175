"""The phases of picking up a cube, and the state kept between actions."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.geometry import quarter_turn_near
from roboneuron.sight.cube import CubeEstimate

F64 = NDArray[np.float64]

OPEN, CLOSED = 1.0, 0.0
"""Gripper commands."""

_ANOTHER_PLACE_M = 0.03
_NEW_SHARE = 0.4


class Phase(Enum):
    """Phases of the policy; the value is the word shown to the agent."""

    SEARCH = "looking for"
    RELEASE = "putting down what it holds before picking up"
    APPROACH = "approaching"
    DESCEND = "descending to"
    GRASP = "grasping"
    LIFT = "lifting"
    HOLD = "holding"
    RETREAT = "retreating to look again for"


@dataclass(frozen=True, kw_only=True, slots=True)
class Target:
    """Estimated pose of the cube.

    Attributes:
        x_m, y_m: centre in the base frame.
        yaw_rad: the TCP yaw that aligns the fingers with its faces, nearest to the present one.
        is_clear: True if at least one clear view contributed.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    is_clear: bool

    @classmethod
    def first(cls, estimate: CubeEstimate, yaw_rad: float) -> Target:
        """Estimate from a single view; `yaw_rad` is the present yaw of the TCP."""
        return cls(
            x_m=estimate.x_m,
            y_m=estimate.y_m,
            yaw_rad=quarter_turn_near(estimate.yaw_rad, yaw_rad) if estimate.is_clear else yaw_rad,
            is_clear=estimate.is_clear,
        )

    def updated(self, estimate: CubeEstimate) -> Target:
        """Estimate after another view: clear views are averaged; a clear view that is far away, or
        follows unclear ones, replaces the estimate.
        """
        if not estimate.is_clear:
            return self
        yaw = quarter_turn_near(estimate.yaw_rad, self.yaw_rad)
        distance = np.hypot(estimate.x_m - self.x_m, estimate.y_m - self.y_m)
        share = _NEW_SHARE if self.is_clear and distance < _ANOTHER_PLACE_M else 1.0
        return Target(
            x_m=self.x_m + share * (estimate.x_m - self.x_m),
            y_m=self.y_m + share * (estimate.y_m - self.y_m),
            yaw_rad=self.yaw_rad + share * (yaw - self.yaw_rad),
            is_clear=True,
        )


@dataclass(kw_only=True, slots=True)
class ServoEpisode:
    """State of one attempt to follow one instruction.

    Attributes:
        phase: present phase.
        steps: actions given in this phase.
        attempts: number of failed grasps.
        target: estimate of the cube; None before it was seen.
        anchor: TCP pose (4, 4) at the start of the phase.
        openings: measured gripper openings of this phase, oldest first.
        failure: reason why the episode was given up; empty while it runs.
    """

    phase: Phase = Phase.SEARCH
    steps: int = 0
    attempts: int = 0
    target: Target | None = None
    anchor: F64 = field(default_factory=lambda: np.eye(4))
    openings: list[float] = field(default_factory=list)
    failure: str = ""

    def enter(self, phase: Phase, T_base_tcp: F64) -> None:
        """Start a phase with the TCP at `T_base_tcp` (4, 4)."""
        self.phase = phase
        self.steps = 0
        self.anchor = T_base_tcp.copy()
        self.openings.clear()
