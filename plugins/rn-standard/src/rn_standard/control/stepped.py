"""Control in stepped time: the same actions give the same commands, however long they take."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from roboneuron import JointCommand
from roboneuron.node import LimitedCommand

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray

    from rn_standard.control.module import ControlModule

_STEP_S = 0.1
"""Time of each action, as of the tools of an arm."""
_LOOK_S = 0.002
_PAUSE_S = 10.0
"""Counts as passed while the arm rests: the next action begins a motion."""


class SteppedActions:
    """Executes each action with the first joints that were measured after it was sent: the
    simulation has waited for it, so these are the same in every run.

    The arm's time is the sum of its commands, each of which has `_STEP_S`. Stops and ages go by
    the real clock, as always.
    """

    def __init__(
        self,
        control: ControlModule,
        execute: Callable[[Float64MultiArray, Mapping[str, int]], None],
    ) -> None:
        """Take over what paces `control`. Used from the executor's thread.

        Args:
            control: with its limits.
            execute: takes an action's message and its info, as ROS gives them.
        """
        self._control, self._execute = control, execute
        self._now_s = _PAUSE_S
        self._pending: tuple[Float64MultiArray, Mapping[str, int]] | None = None
        control.clock = lambda: self._now_s
        control.step_s = self._step_s  # type: ignore[method-assign]
        control.on_limited.append(self._note)
        control.node.repeat(_LOOK_S, self._look)

    def take(self, message: Float64MultiArray, info: Mapping[str, int]) -> None:
        """Execute an action as soon as the joints are measured; a newer one replaces it."""
        self._pending = message, info
        self._look()

    def _look(self) -> None:
        joints, pending = self._control.watched.joints, self._pending
        if pending is None or joints is None:
            return
        if joints.stamp_ns <= int(pending[1]["source_timestamp"]):
            return
        self._pending = None
        if joints.velocity is not None and not np.any(joints.velocity):
            self._now_s += _PAUSE_S
        self._execute(*pending)

    def _step_s(self, source_ns: int, now_s: float) -> float:
        """As `HoldingModule.step_s`."""
        self._control.action_ns = source_ns
        return _STEP_S

    def _note(self, limited: LimitedCommand) -> None:
        """The time of a command passes before the next one."""
        if isinstance(limited.command, JointCommand):
            self._now_s += limited.command.duration_s
