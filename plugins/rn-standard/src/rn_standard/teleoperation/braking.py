"""Braking of an arm that nobody leads any more, in the control process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from roboneuron import JointCommand, JointKinds, JointSample, RobotProfile

BRAKE_S = 0.07
"""Time in which an arm that is led can stop: no joint is led faster than its acceleration times
this. Of the 0.2 s to rest, the others are for the silence, a command in progress, and the robot's
lag.
"""
_MOST_S = 0.3
"""Time after which the arm is held wherever it is."""
_REST_S = 0.04
"""Time without a reason to brake: the last commands have come to their end."""
NEAR = 2e-3
"""Distance [rad or m] within which an arm has come to where it was commanded."""


@dataclass(kw_only=True, slots=True)
class Braking:
    """Brakes an arm within its limits, by a command in each period, until it rests. Has no clock.

    A hold alone takes longer: it commands the measured posture, which a moving arm has passed when
    it stands still, so that the arm returns to it.

    Attributes:
        step: sends one command that brakes; returns True while the arm cannot stop within it, or
            has not come to its end.
        is_holding: returns True if the arm is held already, or may not be commanded.
    """

    step: Callable[[], bool]
    is_holding: Callable[[], bool]
    _begun_s: float | None = None
    _moving_s: float = 0.0

    def reset(self) -> None:
        """Forget the braking, because the arm is led again."""
        self._begun_s = None

    def advance(self, now_s: float) -> bool:
        """Send a command if the arm still moves; return True once it rests.

        Args:
            now_s: monotonic time.
        """
        if self.is_holding():
            return True
        if self._begun_s is None:
            self._begun_s = self._moving_s = now_s
        if now_s - self._begun_s >= _MOST_S or now_s - self._moving_s >= _REST_S:
            return True
        if self.step():
            self._moving_s = now_s
        return False


def is_away(command: JointCommand, joints: JointSample, kinds: JointKinds) -> bool:
    """True if a measured joint is not where a command sends it, within `NEAR`."""
    found = dict(zip(joints.names, joints.position.tolist(), strict=False))
    goals = zip(command.names, command.position.tolist(), strict=True)
    return any(abs(kinds.difference(name, found[name], goal)) > NEAR for name, goal in goals)


def stoppable(command: JointCommand, joints: JointSample, profile: RobotProfile) -> JointCommand:
    """Shorten a command, in its direction through joint space, so that the arm can stop from it
    within `BRAKE_S`.

    Args:
        command: of the arm's joints, and possibly of grippers, which are left as they are.
        joints: where it begins.
        profile: a robot without limits of its own is not slowed down.
    """
    limits = profile.limits
    if limits is None:
        return command
    found = dict(zip(joints.names, joints.position.tolist(), strict=False))
    hardest = dict(zip(profile.arm_joints, limits.acceleration.tolist(), strict=True))
    arm = [index for index, name in enumerate(command.names) if name in hardest]
    names = [command.names[index] for index in arm]
    start = np.array([found[name] for name in names])
    most = np.array([hardest[name] for name in names]) * (BRAKE_S * command.duration_s)
    change = command.position[arm] - start
    share = float((np.abs(change) / most).max(initial=1.0))
    position = command.position.copy()
    position[arm] = start + change / share
    return replace(command, position=position)
