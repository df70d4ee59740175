"""Exclusive execution of tasks: one at a time, ended by any stop of the robot, and awaited at the
end of the server.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from roboneuron import CallContext, StateError, Tool
from roboneuron.feature import StillReason

CHANGES_POLICY = frozenset({"set_instruction"})
"""Tools that would change the policy's behaviour during a task."""


class TaskArbiter:
    """At most one task. Usable from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle = threading.Condition(self._lock)
        self._halt: threading.Event | None = None
        self._owner = ""
        self._reason = ""

    @property
    def reason(self) -> str:
        """Reason for which the present or last task was ended; empty if it was not."""
        return self._reason

    @property
    def owner(self) -> str:
        """Owner of the running task, as text; empty without one."""
        return self._owner

    @contextmanager
    def claim(self, owner: str, halt: threading.Event) -> Iterator[None]:
        """Claim the exclusive execution of a task.

        Args:
            owner: as text, for messages.
            halt: set when the task has to end.

        Raises:
            StateError: there is another one.
        """
        with self._lock:
            if self._halt is not None:
                raise StateError(
                    f"A task runs already: {self._owner}.",
                    hint="Wait for its end, or cancel that call.",
                )
            self._halt, self._owner, self._reason = halt, owner, ""
        try:
            yield
        finally:
            with self._idle:
                self._halt, self._owner = None, ""
                self._idle.notify_all()

    def end(self, reason: str, timeout_s: float = 0.0) -> bool:
        """End the task, with a reason as text, and wait; return False if it did not end in time."""
        with self._idle:
            if self._halt is not None:
                self._reason = self._reason or reason
                self._halt.set()
            return self._idle.wait_for(lambda: self._halt is None, timeout_s)

    def check_idle(self, tool: Tool, context: CallContext) -> None:
        """Raise RefusedError during a task."""
        for reason in self.still_reasons():
            raise reason.refusal()

    def still_reasons(self) -> Sequence[StillReason]:
        """What a task keeps from moving the robot: everything else."""
        if self._halt is None:
            return ()
        reason = StillReason(
            rank="claim",
            rule="ownership",
            message=f"A task runs: {self._owner}.",
            hint="Cancel that call, or call stop_inference, which ends the task too.",
        )
        return (reason,)
