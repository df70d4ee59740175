"""Who carries out a task now: one at a time, ended by whoever stops the robot, and waited for when
the server ends.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from roboneuron import CallContext, RefusedError, StateError, Tool

_OURS = frozenset({"set_instruction"})
"""Tools that would change what the policy of a running task does."""


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
        """Why the task that runs, or has just ended, was told to end; empty when nobody has told
        it.
        """
        return self._reason

    @property
    def owner(self) -> str:
        """Who carries out a task now, in words; empty when nobody does."""
        return self._owner

    @contextmanager
    def claim(self, owner: str, halt: threading.Event) -> Iterator[None]:
        """Be the one task.

        Args:
            owner: in words, for messages.
            halt: set when the task is to end.

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
        """Have the task end now, for a reason in words, and wait; False when it did not in time."""
        with self._idle:
            if self._halt is not None:
                self._reason = self._reason or reason
                self._halt.set()
            return self._idle.wait_for(lambda: self._halt is None, timeout_s)

    def admit(self, tool: Tool, context: CallContext) -> None:
        """Refuse calls that would change what the running task's policy does."""
        if tool.name in _OURS and self._halt is not None:
            raise RefusedError(
                f"A task runs: {self._owner}.",
                hint="Cancel that call, or call stop_inference, which ends the task too.",
                rule="ownership",
            )
