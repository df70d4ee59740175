"""The phases of picking up a cube and what is remembered from one action to the next."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.cube import CubeEstimate
from rn_backend_servo.geometry import quarter_turn_near

F64 = NDArray[np.float64]

OPEN, CLOSED = 1.0, 0.0
"""Gripper commands."""

_ANOTHER_PLACE_M = 0.03
_NEW_SHARE = 0.4


class Phase(Enum):
    """What the policy is doing; the value is the word shown to the agent."""

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
    """Where the cube is believed to be.

    Attributes:
        x_m, y_m: centre in the base frame.
        yaw_rad: the TCP yaw that aligns the fingers with its faces, nearest to the present one.
        is_clear: at least one clear view went into it.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    is_clear: bool

    @classmethod
    def first(cls, estimate: CubeEstimate, yaw_rad: float) -> Target:
        """From a single view; `yaw_rad` is the present yaw of the TCP."""
        return cls(
            x_m=estimate.x_m,
            y_m=estimate.y_m,
            yaw_rad=quarter_turn_near(estimate.yaw_rad, yaw_rad) if estimate.is_clear else yaw_rad,
            is_clear=estimate.is_clear,
        )

    def updated(self, estimate: CubeEstimate) -> Target:
        """After another view: clear ones are averaged, a clear one far away or after unclear ones
        replaces.
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
    """What is remembered within one attempt to follow one instruction.

    Attributes:
        phase: what is being done.
        steps: actions given in this phase.
        attempts: grasps that failed.
        target: where the cube is; None before it was seen.
        anchor: TCP pose (4, 4) when the phase began.
        openings: measured gripper openings of this phase, oldest first.
        failure: why the episode was given up; empty while it goes on.
    """

    phase: Phase = Phase.SEARCH
    steps: int = 0
    attempts: int = 0
    target: Target | None = None
    anchor: F64 = field(default_factory=lambda: np.eye(4))
    openings: list[float] = field(default_factory=list)
    failure: str = ""

    def enter(self, phase: Phase, T_base_tcp: F64) -> None:
        """Begin a phase with the TCP at `T_base_tcp` (4, 4)."""
        self.phase = phase
        self.steps = 0
        self.anchor = T_base_tcp.copy()
        self.openings.clear()
