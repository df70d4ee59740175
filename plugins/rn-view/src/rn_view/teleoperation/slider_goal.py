"""Joint goal that a person sets with sliders, approached at a bounded speed.

Nothing is sent to the robot from here. Programs poll the goal (`LEAD_PATH`), for instance lerobot's
teleoperator, whose actions pass control like any others.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping

from roboneuron import NotReadyError, RefusedError, RobotProfile

LEAD_PATH = "/lead"
"""GET: the present goal, as JSON with `positions` by joint [rad or m]; `?robot=NAME`."""
RENEWED_S = 1.5
"""A page that has not answered for this time stops leading."""
_SPEED_SHARE = 0.25
"""Share of the robot's velocity limits: a slider may jump, the arm must not."""
_GRIPPER_S = 1.5
"""Time for a full opening or closing."""
_MOST_AHEAD = 0.1
"""Maximum distance of the goal from the arm [rad or m], so that the arm does not catch up at once
after control held it back. Below the 0.3 that control refuses.
"""
_MOST_STEP_S = 0.1
"""Maximum time step of the goal, also after a pause in the requests."""


class SliderGoal:
    """Joint goal of one robot, and the page that leads it; usable from any thread.

    Attributes:
        bounds: lowest and highest position by joint [rad or m], arms first, then grippers; half a
            turn either way for a joint that turns without end.
    """

    def __init__(self, profile: RobotProfile, clock: Callable[[], float] = time.monotonic) -> None:
        """Args:
        profile: of the robot. A robot without limits cannot be led.
        clock: monotonic [s].
        """
        self._clock = clock
        self._lock = threading.Lock()
        self._leader: object | None = None
        self._renewed_s = self._asked_s = 0.0
        self._aims: dict[str, float] = {}
        self._goals: dict[str, float] = {}
        self.bounds: dict[str, tuple[float, float]] = {}
        self._speeds: dict[str, float] = {}
        self._arm_joints = frozenset(profile.arm_joints)
        self._kinds = profile.kinds
        self._endless: set[str] = set()
        limits = profile.limits
        if limits is None:
            return
        for i, joint in enumerate(profile.arm_joints):
            low, high = float(limits.lower[i]), float(limits.upper[i])
            if not (math.isfinite(low) and math.isfinite(high)):
                self._endless.add(joint)
                low, high = -math.pi, math.pi
            self.bounds[joint] = low, high
            self._speeds[joint] = _SPEED_SHARE * float(limits.velocity[i])
        for gripper in profile.grippers:
            ends = sorted((gripper.closed_position, gripper.open_position))
            self.bounds[gripper.joint] = ends[0], ends[1]
            self._speeds[gripper.joint] = (ends[1] - ends[0]) / _GRIPPER_S

    def begin(self, who: object, measured: Mapping[str, float]) -> dict[str, float]:
        """Start to lead from the measured positions, which are returned by joint.

        Raises:
            RefusedError: another page leads.
            NotReadyError: a joint has no measurement.
        """
        absent = [joint for joint in self.bounds if joint not in measured]
        if absent:
            raise NotReadyError(
                f"The robot does not report {', '.join(absent)}.", hint="Start the robot first."
            )
        with self._lock:
            if self._is_led() and self._leader is not who:
                raise RefusedError("Another page leads this robot.", rule="operator")
            self._leader = who
            self._renewed_s = self._asked_s = self._clock()
            self._goals = {joint: measured[joint] for joint in self.bounds}
            self._aims = {joint: self._bounded(joint, at) for joint, at in self._goals.items()}
            return {
                joint: self._kinds.nearest(joint, 0.0, aim) if joint in self._endless else aim
                for joint, aim in self._aims.items()
            }

    def aim(self, who: object, joint: str, position: float) -> None:
        """Set the target of a joint [rad or m]; ignored unless the page leads."""
        with self._lock:
            if self._leader is who:
                self._aims[joint] = self._bounded(joint, position)

    def renew(self, who: object) -> bool:
        """Record that the page of `who` is still open; returns whether it still leads."""
        with self._lock:
            if self._leader is not who or not self._is_led():
                return False
            self._renewed_s = self._clock()
            return True

    def is_led_by(self, who: object) -> bool:
        """Whether that page leads."""
        with self._lock:
            return self._leader is who and self._is_led()

    def end(self, who: object) -> None:
        """Stop leading if this page leads; there is no goal then."""
        with self._lock:
            if self._leader is who:
                self._leader = None

    def goal(self, measured: Mapping[str, float]) -> dict[str, float] | None:
        """Next goal by joint on the way to the targets; None if no page leads.

        Args:
            measured: position by joint [rad or m]; the goal stays near it.
        """
        with self._lock:
            if not self._is_led():
                self._leader = None
                return None
            now_s = self._clock()
            step_s = min(now_s - self._asked_s, _MOST_STEP_S)
            self._asked_s = now_s
            for joint, aim in self._aims.items():
                step = self._speeds[joint] * step_s
                goal = self._goals[joint] + min(max(aim - self._goals[joint], -step), step)
                if joint in self._arm_joints and joint in measured:
                    at = self._kinds.nearest(joint, self._goals[joint], measured[joint])
                    goal = min(max(goal, at - _MOST_AHEAD), at + _MOST_AHEAD)
                self._goals[joint] = goal
            return dict(self._goals)

    def _bounded(self, joint: str, position: float) -> float:
        """A position within the bounds, in the turns of the goal."""
        if joint in self._endless:
            return self._kinds.nearest(joint, self._goals[joint], position)
        low, high = self.bounds[joint]
        return min(max(position, low), high)

    def _is_led(self) -> bool:
        """Whether a page leads; the caller holds the lock."""
        return self._leader is not None and self._clock() - self._renewed_s < RENEWED_S
