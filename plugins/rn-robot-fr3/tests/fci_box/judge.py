"""Checks the arm's commanded positions, including extrapolated ones, against the published limits
of the FR3.
"""

from __future__ import annotations

from math import isfinite, sqrt

from rn_robot_fr3.fci.follower import JOINTS, STEP_S, CommandedState
from rn_robot_fr3.limits import (
    ACCELERATION_RAD_S2,
    BRAKING_DECELERATION_RAD_S2,
    BRAKING_OFFSET_RAD_S,
    JERK_RAD_S3,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RAD_S,
)

_EXACT = 1e-6
"""Relative tolerance for 64-bit arithmetic."""
_KEPT = 20
_LEAST_RAD_S = 1e-3
"""Tolerance where the arm accepts no velocity."""


class CommandJudge:
    """Tracks one arm over all its motions.

    Attributes:
        arm: last commanded state; None between motions.
        counts: number of events by name.
        beyond: descriptions of the first violations.
    """

    def __init__(self) -> None:
        self.arm: CommandedState | None = None
        self.counts = dict.fromkeys(("commands", "extrapolated", "violations", "longest_gap"), 0)
        self.worst = dict.fromkeys(("velocity", "acceleration", "jerk"), 0.0)
        self.beyond: list[str] = []
        self._gap = 0

    def begin(self, position: list[float]) -> None:
        """Start a motion at rest at `position`."""
        self.arm = CommandedState(position, [0.0] * JOINTS, [0.0] * JOINTS)
        self._gap = 0

    def take(self, position: list[float]) -> None:
        """Process a command that came in its cycle."""
        assert self.arm is not None
        self.counts["commands"] += 1
        if not all(map(isfinite, position)):
            self._note(f"command is not finite: {position}")
            return
        self._judge(self.arm.sent(position), "command")
        self._gap = 0

    def miss(self) -> None:
        """Process a cycle without a command."""
        assert self.arm is not None
        self._gap += 1
        self.counts["extrapolated"] += 1
        self.counts["longest_gap"] = max(self.counts["longest_gap"], self._gap)
        self._judge(self.arm.missed(1), "extrapolation")

    def report(self) -> dict[str, object]:
        """All counts and extremes, relative to the limits where they exist."""
        worst = {f"worst_{name}": round(value, 4) for name, value in self.worst.items()}
        return {**self.counts, **worst, "beyond": self.beyond}

    def _judge(self, now: CommandedState, what: str) -> None:
        before = self.arm
        assert before is not None
        for joint in range(JOINTS):
            position, velocity = now.position[joint], now.velocity[joint]
            acceleration = now.acceleration[joint]
            jerk = (acceleration - before.acceleration[joint]) / STEP_S
            shares = {
                "velocity": abs(velocity)
                / max(_fastest(joint, position, velocity > 0.0), _LEAST_RAD_S),
                "acceleration": abs(acceleration) / ACCELERATION_RAD_S2[joint],
                "jerk": abs(jerk) / JERK_RAD_S3[joint],
            }
            for name, share in shares.items():
                self.worst[name] = max(self.worst[name], share)
                if share > 1.0 + _EXACT:
                    of = f"{name} of joint {joint + 1}"
                    self._note(
                        f"{what} after a gap of {self._gap}: {of} is {share:.3f} of its limit"
                    )
            if not LOWER_RAD[joint] <= position <= UPPER_RAD[joint]:
                self._note(f"{what}: joint {joint + 1} is beyond its limit at {position} rad")
        self.arm = now

    def _note(self, text: str) -> None:
        self.counts["violations"] += 1
        if len(self.beyond) < _KEPT:
            self.beyond.append(text)


def _fastest(joint: int, position: float, is_upwards: bool) -> float:
    """Highest accepted velocity at a position; see `rn_robot_fr3.limits.velocity_bounds`."""
    room = UPPER_RAD[joint] - position if is_upwards else position - LOWER_RAD[joint]
    braking = (
        sqrt(2.0 * BRAKING_DECELERATION_RAD_S2[joint] * max(room, 0.0))
        - BRAKING_OFFSET_RAD_S[joint]
    )
    return max(0.0, min(braking, VELOCITY_RAD_S[joint]))
