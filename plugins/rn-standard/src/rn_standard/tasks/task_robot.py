"""Interface of a task to its robot, which also provides the time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from rn_standard.tasks.snapshot import Snapshot
from roboneuron import Picture


@dataclass(frozen=True, kw_only=True, slots=True)
class PolicyState:
    """State of the policy that executes a task.

    Attributes:
        has_acted: it has published an action for this attempt.
        failure: reason why it gave up; empty while it works.
        taken: reason why it no longer works for this task (stopped, another instruction); empty
            while it does.
        led: name of the person who temporarily leads the arm by hand instead; empty for none.
    """

    has_acted: bool
    failure: str = ""
    taken: str = ""
    led: str = ""


class TaskRobot(Protocol):
    """Interface of the robot for one task. Used from one thread."""

    def now_s(self) -> float:
        """Monotonic time [s]."""
        ...

    def wait(self, seconds: float) -> bool:
        """Wait; returns at once with True if the task has to end."""
        ...

    def begin(self, instruction: str) -> None:
        """Send the policy the instruction again; the robot may move from here on.

        Raises:
            RoboNeuronError: it cannot act.
        """
        ...

    def policy(self) -> PolicyState:
        """State of the policy."""
        ...

    def look(self) -> Snapshot:
        """Present state of the robot."""
        ...

    def end(self) -> None:
        """Stop the policy; the arm comes to rest. Never raises, and may be called twice."""
        ...

    def evidence(self, when: str) -> tuple[Picture, ...]:
        """Present images of the cameras, with "before" or "after" in their captions; empty without
        any.
        """
        ...
