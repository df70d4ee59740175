"""Time of a task: the real one, or that of a clock which lets the policy act in turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from threading import Event
from typing import Protocol, runtime_checkable

from roboneuron.feature import ModuleKind
from roboneuron.sight.inputs import Inputs


class TaskTime:
    """Time of one task, on its thread; this base class is the real time.

    Args:
        halt: set when the task has to end.

    Attributes:
        age_factor: measurements may be so many times older than usual.
    """

    age_factor = 1.0

    def __init__(self, halt: Event) -> None:
        self._halt = halt

    def open(self) -> None:
        """Wait until the task may begin. Raises RoboNeuronError."""

    def now_s(self) -> float:
        """See `TaskRobot.now_s`."""
        return time.monotonic()

    def wait(self, seconds: float) -> bool:
        """See `TaskRobot.wait`."""
        return self._halt.wait(seconds)

    def hold_policy(self) -> None:
        """Let the policy not act: it is about to get its instruction, or was just started. Raises
        RoboNeuronError.
        """

    def let_policy_act(self) -> None:
        """Let the policy act as time passes, because it has its instruction."""

    def await_measured(self, inputs: Inputs, topics: Mapping[ModuleKind, Sequence[str]]) -> None:
        """Wait until the newest messages show the present.

        Args:
            inputs: has them.
            topics: what each module measures.
        """

    def end(self) -> None:
        """End the task's time: the instruction was withdrawn."""


@runtime_checkable
class TimesTasks(Protocol):
    """A `RobotClock` that also has a time for tasks."""

    def task_time(self, halt: Event, is_lost: Callable[[], bool]) -> TaskTime:
        """Create the time of one task.

        Args:
            halt: set when the task has to end.
            is_lost: returns True once the task has lost the policy or a module.
        """
