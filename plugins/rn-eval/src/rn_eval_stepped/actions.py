"""Control in stepped time: the same actions give the same commands, however long they take."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from std_msgs.msg import Float64MultiArray

from rn_eval_stepped.world_clock import (
    CLOSED_METRIC,
    END_PARAMETER,
    ENDED,
    SIMULATION_TOPIC,
    SKIPPED,
)
from roboneuron import JointCommand
from roboneuron.feature import LimitedCommand
from roboneuron.modules.step_filters import ActionStep, StepFilter

if TYPE_CHECKING:
    from roboneuron.modules.control.module import ControlModule

_STEP_S = 0.1
"""Time of each action, as of the tools of an arm."""
_LOOK_S = 0.002
_PAUSE_S = 10.0
"""Counts as passed while the arm rests: the next action begins a motion."""
_CLOSES = 0.05
"""Fraction of the travel: a smaller change of the commanded opening is not a grasp."""


class SteppedActions(StepFilter):
    """Executes each action with the first joints that were measured after it was sent: the
    simulation has waited for it, so these are the same in every run.

    The arm's time is the sum of its commands, each of which has `_STEP_S`. Stops and ages go by
    the real clock, as always. The simulation is told of actions that move nothing, and of the last
    command, so that nobody guesses that by the wall clock.
    """

    phase = StepFilter.StepPhase.CLOCK

    def __init__(self, control: ControlModule) -> None:
        """Pace `control`, which has its limits. Used from the executor's thread."""
        self._control = control
        self._now_s = _PAUSE_S
        self._openings: dict[str, float] = {}
        self._pending: tuple[ActionStep, Callable[[ActionStep], None]] | None = None
        control.clock = lambda: self._now_s
        control.fixed_step_s = _STEP_S
        node = control.node
        self._simulation = node.advertise(Float64MultiArray, SIMULATION_TOPIC)
        node.resources.callback(node.add_parameter(END_PARAMETER, -1, self._end))
        node.repeat(_LOOK_S, self._look)

    def act(self, step: ActionStep, proceed: Callable[[ActionStep], None]) -> None:
        """Execute an action as soon as the joints are measured; a newer one replaces it."""
        self._pending = step, proceed
        self._look()

    def _look(self) -> None:
        joints, pending = self._control.watched.joints, self._pending
        if pending is None or joints is None:
            return
        step, proceed = pending
        if joints.stamp_ns <= step.source_ns:
            return
        self._pending = None
        if joints.velocity is not None and not np.any(joints.velocity):
            self._now_s += _PAUSE_S
        control = self._control
        acted_s, was_holding = control.action_s, control.is_holding
        proceed(step)
        is_held_again = was_holding and control.is_holding
        if control.action_s == acted_s or is_held_again:  # nothing was sent
            self._tell(SKIPPED)

    def _end(self, count: int) -> None:
        """See `END_PARAMETER`."""
        self._tell(ENDED, count)

    def _tell(self, word: int, count: int = 0) -> None:
        self._simulation.publish(Float64MultiArray(data=[float(word), float(count)]))

    def note_limited(self, limited: LimitedCommand) -> None:
        """The time of a command passes before the next one."""
        if isinstance(limited.command, JointCommand):
            self._now_s += limited.command.duration_s
            self._note_openings(limited.command)

    def _note_openings(self, command: JointCommand) -> None:
        """Report how high the hand is that closes: tools see that only at a wall time."""
        control = self._control
        for number, arm in enumerate(control.profile.each_arm):
            joints, now = control.watched.joints, arm.opening_in(command)
            if now is None or joints is None:
                continue
            before = self._openings.get(arm.name, 1.0)
            self._openings[arm.name] = now
            if before - now > _CLOSES:
                metric = f"{arm.name}/{CLOSED_METRIC}" if arm.name else CLOSED_METRIC
                height_m = float(control.poses(joints)[number].position_m[2])
                control.status.set_value(metric, height_m)
                control.status.changed.set()
