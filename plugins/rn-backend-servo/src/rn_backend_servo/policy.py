"""The state machine that maps images and proprioception to the next small motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_backend_servo.geometry import downward, rotation_between, yaw_of
from rn_backend_servo.options import ServoOptions
from rn_backend_servo.phases import CLOSED, OPEN, Phase, ServoEpisode, Target
from rn_backend_servo.sight import Sighting
from roboneuron import UngroundedError

F64 = NDArray[np.float64]

_NEAR_M, _NEAR_HEIGHT_M, _NEAR_RAD = 0.004, 0.006, 0.04
"""Tolerances within which the TCP has reached a goal: horizontal, vertical and rotational."""
_STRAY_M = 0.008
"""Horizontal deviation from its line at which the descent pauses."""
_BLIND_M = 0.09
"""Height of the TCP above the table below which the fingers hide the cube, so that its last
estimate is kept.
"""
_SEEN_TWICE = 2
_CLOSING_STEPS, _STEADY_STEPS, _STEADY = 6, 3, 0.02
"""A grasp is evaluated after this number of actions, once the opening changes by less than _STEADY
over _STEADY_STEPS.
"""
_FULLY_OPEN = 0.85
_MOST_STEPS = {
    Phase.APPROACH: 150,
    Phase.DESCEND: 80,
    Phase.GRASP: 30,
    Phase.LIFT: 80,
    Phase.RETREAT: 80,
}
_MOST_STEPS_RELEASE = 120


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ServoMotion:
    """One small motion.

    Attributes:
        translation_m, rotation_rad: float64 (3,) each, TCP delta in the base frame.
        gripper_open: 0 closed .. 1 open.
        remaining_m: distance to the goal of the phase.
        goal: TCP pose (4, 4) that it leads to; None if the arm should stay.
    """

    translation_m: F64
    rotation_rad: F64
    gripper_open: float
    remaining_m: float = 0.0
    goal: F64 | None = None


class PickPolicy:
    """Search, approach, descend, grasp, verify, lift, hold; retries a bounded number of times."""

    def __init__(self, options: ServoOptions) -> None:
        self._options = options
        self.episode = ServoEpisode()
        self._start = np.eye(4)

    def reset(self) -> None:
        """Reset the policy."""
        self.episode = ServoEpisode()

    def step(
        self,
        sighting: Sighting | None,
        T_base_tcp: F64,
        gripper_open: float,
        start: F64 | None = None,
    ) -> ServoMotion:
        """Return the next motion.

        Transitions depend on the measured pose; the motion starts from the predicted pose.

        Args:
            sighting: the named cube; None if it is not visible, which is not allowed in phase
                SEARCH.
            T_base_tcp: measured TCP pose (4, 4).
            gripper_open: measured opening.
            start: TCP pose (4, 4) at the start of the motion; None for the measured one.

        Raises:
            UngroundedError: every attempt failed, or the arm does not reach its goals; `reset`
                starts a new episode.
        """
        episode = self.episode
        if episode.failure:
            raise UngroundedError(episode.failure, hint="Give the instruction again to restart.")
        self._start = T_base_tcp if start is None else start
        episode.steps += 1
        episode.openings.append(gripper_open)
        action = {
            Phase.SEARCH: self._search,
            Phase.RELEASE: self._release,
            Phase.APPROACH: self._approach,
            Phase.DESCEND: self._descend,
            Phase.GRASP: self._grasp,
            Phase.LIFT: self._lift,
            Phase.HOLD: self._hold,
            Phase.RETREAT: self._retreat,
        }[episode.phase]
        return action(sighting, T_base_tcp, gripper_open)

    def continued(self, motion: ServoMotion, start: F64) -> ServoMotion:
        """The motion after `motion`: from `start` (4, 4) towards the same goal with the same
        opening.
        """
        self._start = start
        return motion if motion.goal is None else self._towards(motion.goal, motion.gripper_open)

    def _search(self, sighting: Sighting | None, tcp: F64, gripper_open: float) -> ServoMotion:
        episode = self.episode
        assert sighting is not None
        if episode.steps == 1 and self._options.holding_open < gripper_open < _FULLY_OPEN:
            episode.enter(Phase.RELEASE, tcp)
            return self._release(sighting, tcp, gripper_open)
        self._see(sighting, tcp)
        if episode.steps >= _SEEN_TWICE:
            episode.enter(Phase.APPROACH, tcp)
        return ServoMotion(translation_m=np.zeros(3), rotation_rad=np.zeros(3), gripper_open=OPEN)

    def _approach(self, sighting: Sighting | None, tcp: F64, gripper_open: float) -> ServoMotion:
        self._see(sighting, tcp)
        target, options = self._target(), self._options
        goal = self._goal(target.x_m, target.y_m, options.hover_m, target.yaw_rad)
        if self._is_near(goal, tcp) and gripper_open > _FULLY_OPEN:
            if target.is_clear:
                self.episode.enter(Phase.DESCEND, tcp)
            elif self.episode.steps > _MOST_STEPS[Phase.APPROACH] // 2:
                return self._failed("the cube could not be seen as a whole", tcp)
        if self._is_late():
            return self._failed("the arm did not get above the cube", tcp)
        return self._towards(goal, OPEN)

    def _descend(self, sighting: Sighting | None, tcp: F64, gripper_open: float) -> ServoMotion:
        options = self._options
        if tcp[2, 3] > options.table_m + _BLIND_M:
            self._see(sighting, tcp)
        target = self._target()
        goal = self._goal(target.x_m, target.y_m, options.grasp_m, target.yaw_rad)
        if self._is_near(goal, tcp):
            self.episode.enter(Phase.GRASP, tcp)
            return self._towards(goal, CLOSED)
        if self._is_late():
            return self._failed("the arm did not get down to the cube", tcp)
        if np.hypot(*(goal[:2, 3] - self._start[:2, 3])) > _STRAY_M:
            goal[2, 3] = self._start[2, 3]
        return self._towards(goal, OPEN)

    def _grasp(self, sighting: Sighting | None, tcp: F64, gripper_open: float) -> ServoMotion:
        episode, target = self.episode, self._target()
        goal = self._goal(target.x_m, target.y_m, self._options.grasp_m, target.yaw_rad)
        recent = episode.openings[-_STEADY_STEPS:]
        is_steady = episode.steps >= _CLOSING_STEPS and max(recent) - min(recent) < _STEADY
        if is_steady or self._is_late():
            if gripper_open <= self._options.holding_open:
                return self._failed("the gripper closed on nothing", tcp)
            if gripper_open > _FULLY_OPEN:
                return self._failed("the gripper did not close", tcp)
            episode.enter(Phase.LIFT, tcp)
        return self._towards(goal, CLOSED)

    def _lift(self, sighting: Sighting | None, tcp: F64, gripper_open: float) -> ServoMotion:
        if gripper_open <= self._options.holding_open:
            return self._failed("the cube slipped out", tcp)
        anchor = self.episode.anchor
        goal = self._goal(
            anchor[0, 3],
            anchor[1, 3],
            anchor[2, 3] - self._options.table_m + self._options.lift_m,
            yaw_of(anchor),
        )
        if abs(goal[2, 3] - tcp[2, 3]) < _NEAR_HEIGHT_M:
            self.episode.enter(Phase.HOLD, tcp)
        elif self._is_late():
            return self._failed("the arm did not lift the cube", tcp)
        return self._towards(goal, CLOSED)

    def _hold(self, sighting: Sighting | None, tcp: F64, gripper_open: float) -> ServoMotion:
        if gripper_open <= self._options.holding_open:
            return self._failed("the cube was dropped", tcp)
        self.episode.openings.clear()
        return ServoMotion(translation_m=np.zeros(3), rotation_rad=np.zeros(3), gripper_open=CLOSED)

    def _retreat(self, sighting: Sighting | None, tcp: F64, gripper_open: float) -> ServoMotion:
        anchor = self.episode.anchor
        goal = self._goal(anchor[0, 3], anchor[1, 3], self._options.retreat_m, yaw_of(anchor))
        if goal[2, 3] - tcp[2, 3] < _NEAR_HEIGHT_M and gripper_open > _FULLY_OPEN:
            self.episode.enter(Phase.SEARCH, tcp)
            self.episode.target = None
        elif self._is_late():
            self.episode.failure = "The arm does not move up as commanded."
        return self._towards(goal, OPEN)

    def _release(self, sighting: Sighting | None, tcp: F64, gripper_open: float) -> ServoMotion:
        """Move straight down with the gripper closed, then open it: a lifted object is put back to
        its place.
        """
        episode, anchor = self.episode, self.episode.anchor
        goal = self._goal(anchor[0, 3], anchor[1, 3], self._options.grasp_m, yaw_of(anchor))
        is_down = tcp[2, 3] - goal[2, 3] < _NEAR_HEIGHT_M
        if gripper_open > _FULLY_OPEN:
            episode.enter(Phase.RETREAT, tcp)
        elif episode.steps > _MOST_STEPS_RELEASE:
            episode.failure = "The gripper could not put down the object that it holds."
        opening = OPEN if is_down or gripper_open > _FULLY_OPEN else CLOSED
        return self._towards(goal, opening)

    def _see(self, sighting: Sighting | None, tcp: F64) -> None:
        if sighting is None:
            return
        target = self.episode.target
        if target is None:
            self.episode.target = Target.first(sighting.estimate, yaw_of(tcp))
        else:
            self.episode.target = target.updated(sighting.estimate)

    def _target(self) -> Target:
        assert self.episode.target is not None
        return self.episode.target

    def _goal(self, x_m: float, y_m: float, height_m: float, yaw_rad: float) -> F64:
        """TCP pose (4, 4) pointing down, `height_m` above the table."""
        goal = np.eye(4)
        goal[:3, :3] = downward(yaw_rad)
        goal[:3, 3] = (x_m, y_m, self._options.table_m + height_m)
        return goal

    def _is_near(self, goal: F64, tcp: F64) -> bool:
        beside, above = np.hypot(*(goal[:2, 3] - tcp[:2, 3])), abs(goal[2, 3] - tcp[2, 3])
        turn = np.linalg.norm(rotation_between(tcp[:3, :3], goal[:3, :3]))
        return bool(beside < _NEAR_M and above < _NEAR_HEIGHT_M and turn < _NEAR_RAD)

    def _is_late(self) -> bool:
        return self.episode.steps > _MOST_STEPS[self.episode.phase]

    def _towards(self, goal: F64, gripper_open: float) -> ServoMotion:
        """A bounded fraction of the motion from the start to `goal`: proportional control."""
        options = self._options
        way = goal[:3, 3] - self._start[:3, 3]
        turn = rotation_between(self._start[:3, :3], goal[:3, :3])
        return ServoMotion(
            translation_m=_shortened(options.gain * way, options.max_step_m),
            rotation_rad=_shortened(options.gain * turn, options.max_turn_rad),
            gripper_open=gripper_open,
            remaining_m=float(np.linalg.norm(way)),
            goal=goal,
        )

    def _failed(self, reason: str, tcp: F64) -> ServoMotion:
        """Count a failed attempt; retreat to look again, or give up."""
        episode = self.episode
        episode.attempts += 1
        if episode.attempts >= self._options.max_attempts:
            episode.failure = (
                f"Gave up after {episode.attempts} attempts; in the last one {reason}."
            )
            raise UngroundedError(episode.failure, hint="Give the instruction again to restart.")
        episode.enter(Phase.RETREAT, tcp)
        return ServoMotion(translation_m=np.zeros(3), rotation_rad=np.zeros(3), gripper_open=OPEN)


def _shortened(vector: F64, longest: float) -> F64:
    length = float(np.linalg.norm(vector))
    return vector if length <= longest else vector * (longest / length)
