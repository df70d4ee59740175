"""The path from action to joint command, as in the control module of a running robot: controller
and limits.

That module is a ROS node on the wall clock; this class runs the same controller and limiter on the
clock of a simulation.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from rn_eval.suite import Setup
from roboneuron import (
    EE_DELTA,
    Action,
    Controller,
    Hold,
    JointCommand,
    JointSample,
    SpaceController,
)
from roboneuron.feature import MotionLimiter, motion_rules, settings

F64 = NDArray[np.float64]
_SHARE_OF_REST = 0.5
"""Share of the remaining motion time that is added to the next row, as in the control module."""


class DeployedArm:
    """Controller and motion limiter of one episode. Used from one thread."""

    def __init__(self, setup: Setup, controller: Controller) -> None:
        """Start without a setpoint, as control does after `activate`.

        Raises:
            ConfigurationError: the limits do not fit the robot, or there is no section [control].
        """
        control = setup.config.control
        assert control is not None  # checked by the plan
        self._control = control
        self._names = setup.profile.arm_joints
        self._controller = controller
        self._limiter = MotionLimiter.of(
            motion_rules(setup.config.limits, setup.profile),
            setup.profile,
            controller,
            immediate=control.command == "joint_state",
            longest_s=setup.config.robot.server_timeout_s,
        )
        self._space = setup.space
        self._action_s = -1e9
        self._holding = True

    def command(
        self, vector: F64, joints: JointSample, now_s: float
    ) -> tuple[JointCommand | None, str]:
        """Compute the command for an action, and a word if it was stopped or changed.

        Args:
            vector: one row of `Setup.space`, contract units.
            joints: current measurement.
            now_s: simulated time [s].

        Returns:
            A command (possibly a hold), or None if it is refused and the previous one continues;
            and "", "scaled" or the code of the hold.
        """
        since_s = now_s - self._action_s
        step_s = self._control.step_s(since_s)
        outcome: JointCommand | Hold | None = self._compute(vector, joints, step_s, now_s)
        word = ""
        if isinstance(outcome, JointCommand):
            verdict = self._limiter.limit(outcome, joints, now_s)
            outcome = verdict.command
            word = (
                f"limit_{verdict.acted[-1]}"
                if outcome is None
                else "scaled"
                if verdict.acted
                else ""
            )
        if outcome is None:
            return None, word
        self._action_s = now_s
        if isinstance(outcome, Hold):
            return self._hold(joints, now_s), outcome.code
        self._holding = False
        return outcome, word

    def _compute(
        self, row: F64, joints: JointSample, step_s: float, now_s: float
    ) -> JointCommand | Hold:
        """Compute the controller's answer to one row, as the control module does."""
        space = self._space
        if space is EE_DELTA:
            return self._controller.compute(Action.from_vector(row), joints, step_s)
        controller = cast("SpaceController", self._controller)  # checked by the plan
        if space.rate_hz:
            step_s = 1.0 / space.rate_hz
        reference = self._limiter.reference(joints, now_s)
        answer = controller.execute(space, row, reference, step_s)
        if space.rate_hz and isinstance(answer, JointCommand):
            more_s = _SHARE_OF_REST * self._limiter.remaining_s(now_s)
            answer = replace(answer, duration_s=answer.duration_s + more_s)
        return answer

    def watch(self, joints: JointSample, now_s: float) -> JointCommand | None:
        """Return a hold if actions have stopped coming; None otherwise, and while already
        holding.
        """
        if self._holding or now_s - self._action_s <= self._control.hold_after_s:
            return None
        return self._hold(joints, now_s)

    def _hold(self, joints: JointSample, now_s: float) -> JointCommand | None:
        if self._holding:
            return None
        self._holding = True
        index = [joints.names.index(name) for name in self._names]
        self._limiter.rest(joints, now_s)
        return JointCommand(
            names=self._names, position=joints.position[index], duration_s=settings.HOLD_DURATION_S
        )
