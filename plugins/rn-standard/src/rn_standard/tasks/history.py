"""History of tasks, kept across restarts: instruction, robot, model and outcome."""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from pydantic import Field

from roboneuron import (
    Arguments,
    CallContext,
    ForeignDataError,
    Resource,
    Result,
    Tool,
    foreign,
)

FILE_NAME = "tasks.jsonl"
TASKS_URI = "roboneuron://tasks/history"
KEPT = 200
"""Number of tasks kept; the file is shortened when it contains twice as many."""
_IN_RESOURCE = 20
_MOST_TEXT = 500
_log = logging.getLogger(__name__)


class PastTask(Result):
    """One call of run_task."""

    at: str = Field(description="when it ended, ISO 8601")
    instruction: str
    outcome: str = Field(description="as of run_task; error: the call failed")
    attempts: int = 0
    reason: str = ""
    took_s: float = 0.0
    robot: str = Field(default="", description="which one, real or simulated")
    model: dict[str, str] = Field(
        default_factory=dict, description="what the policy was started with, by argument"
    )


class ListTasks(Arguments):
    """Arguments of list_tasks."""

    entries: int = Field(default=10, ge=1, le=50, description="At most so many.")
    contains: str = Field(default="", max_length=200, description="Words of the instruction.")


class TasksResult(Result):
    """Past tasks, newest first."""

    sparse = True

    tasks: list[PastTask]
    more: int = Field(description="further ones that fit the call")


class TaskHistory:
    """File of past tasks in the state directory; thread-safe.

    Args:
        directory: the state directory.
        now: returns the present time.
    """

    def __init__(
        self, directory: Path, now: Callable[[], datetime] = lambda: datetime.now(UTC)
    ) -> None:
        self._path, self._now = directory / FILE_NAME, now
        self._lock = threading.Lock()

    def note(
        self,
        instruction: str,
        outcome: str,
        reason: str,
        *,
        attempts: int = 0,
        took_s: float = 0.0,
        robot: str = "",
        model: dict[str, str] | None = None,
    ) -> None:
        """Add a completed task. A failed write is only logged, because the history must not fail a
        task.
        """
        task = PastTask(
            at=self._now().isoformat(timespec="seconds"),
            instruction=instruction[:_MOST_TEXT],
            outcome=outcome,
            attempts=attempts,
            reason=reason[:_MOST_TEXT],
            took_s=round(took_s, 1),
            robot=robot,
            model=model or {},
        )
        with self._lock:
            try:
                self._append(task.model_dump_json(exclude_defaults=True))
            except OSError as error:
                _log.error("The history of tasks cannot be written: %s", error)

    def _append(self, line: str) -> None:
        known = self._lines()
        if len(known) < 2 * KEPT:
            with _private(self._path, os.O_APPEND) as file:
                file.write(line + "\n")
            return
        whole = self._path.with_suffix(".new")
        with _private(whole, os.O_TRUNC) as file:
            file.write("\n".join([*known[1 - KEPT :], line]) + "\n")
        whole.replace(self._path)

    def _lines(self) -> list[str]:
        try:
            return self._path.read_text(encoding="utf-8", errors="replace").splitlines()
        except FileNotFoundError:
            return []

    def newest(self, contains: str = "") -> list[PastTask]:
        """Past tasks, newest first, whose instruction contains all these words. Incomplete lines
        after a crash are left out.

        Raises:
            OSError: the file cannot be read.
        """
        words = contains.lower().split()
        found: list[PastTask] = []
        with self._lock:
            lines = self._lines()[-KEPT:]
        for line in reversed(lines):
            try:
                task = foreign.decode_model(PastTask, line, "a past task")
            except ForeignDataError:
                continue
            if all(word in task.instruction.lower() for word in words):
                found.append(task)
        return found

    def resource(self) -> Resource:
        """The newest tasks as a JSON resource."""
        return Resource(
            uri=TASKS_URI,
            name="task history",
            title="Past tasks",
            description="The newest calls of run_task and how they ended.",
            read=lambda: json.dumps(
                [task.model_dump(exclude_defaults=True) for task in self.newest()[:_IN_RESOURCE]],
                indent=1,
            ),
            mime_type="application/json",
        )

    def tool(self) -> Tool[ListTasks]:
        """list_tasks."""

        async def list_tasks(arguments: ListTasks, context: CallContext) -> TasksResult:
            found = await context.run(lambda _: self.newest(arguments.contains))
            shown = found[: arguments.entries]
            return TasksResult(tasks=shown, more=len(found) - len(shown))

        return Tool(
            name="list_tasks",
            title="Past tasks",
            description="Past run_task calls, newest first: words, model, outcome and why. Look "
            "before a task.",
            arguments=ListTasks,
            result=TasksResult,
            handler=list_tasks,
            read_only=True,
            idempotent=True,
        )


def _private(path: Path, mode: int) -> IO[str]:
    """Open a file for writing that only its owner can access."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return open(os.open(path, os.O_WRONLY | os.O_CREAT | mode, 0o600), "w", encoding="utf-8")
