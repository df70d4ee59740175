"""History of tasks, of all other motions and of changes, kept across restarts: words, robot, model,
outcome.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, TypedDict, Unpack

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
RUN_TASK = "run_task"
KEPT = 1000
"""Number of entries kept; the file is shortened when it contains twice as many."""
Kind = Literal["task", "instruction", "tool", "lead", "stop", "limits", "recording", "switch"]
_IN_RESOURCE = 20
_MOST_TEXT = 500
_log = logging.getLogger(__name__)


class PastTask(Result):
    """One call that moved the robot, or changed its limits, policy or recording."""

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
    kind: Kind | None = None
    tool: str = Field(default=RUN_TASK, description="the called tool")
    who: str = Field(default="", description="the client")
    calls: int = Field(default=1, description="so many like it, one after the other")
    max_tcp_speed_m_s: float | None = Field(default=None, description="highest, as measured")
    limits: dict[str, int] = Field(
        default_factory=dict, description="limits that acted, with the number of their commands"
    )
    objects_moved: list[object] = Field(
        default_factory=list, description="others than the one it was about, if known"
    )


class MotionFacts(TypedDict, total=False):
    """Further fields of `PastTask`."""

    robot: str
    model: dict[str, str]
    kind: Kind
    tool: str
    who: str
    calls: int
    max_tcp_speed_m_s: float | None
    limits: dict[str, int]
    objects_moved: list[object]


class ListTasks(Arguments):
    """Arguments of list_tasks."""

    entries: int = Field(default=10, ge=1, le=50, description="At most so many.")
    contains: str = Field(default="", max_length=200, description="Words of the instruction.")
    all_robots: bool = Field(default=False, description="Of other robots too.")


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
        robot: returns the present robot, real or simulated.
    """

    def __init__(
        self,
        directory: Path,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
        robot: Callable[[], str] = lambda: "",
    ) -> None:
        self._path, self._now, self.robot = directory / FILE_NAME, now, robot
        # the kept number of lines goes with the file: of two appends only one may trim it
        self._lock = threading.Lock()
        self._count: int | None = None

    def note(
        self,
        instruction: str,
        outcome: str,
        reason: str,
        *,
        attempts: int = 0,
        took_s: float = 0.0,
        at: datetime | None = None,
        **facts: Unpack[MotionFacts],
    ) -> None:
        """Add a motion or change that ended `at` that time, now if None. A failed write is only
        logged, because the history must not fail a task.
        """
        task = PastTask(
            at=(at or self._now()).isoformat(timespec="seconds"),
            instruction=instruction[:_MOST_TEXT],
            outcome=outcome,
            attempts=attempts,
            reason=reason[:_MOST_TEXT],
            took_s=round(took_s, 1),
            **({"robot": self.robot()} | facts),
        )
        with self._lock:
            try:
                self._append(task.model_dump_json(exclude_defaults=True))
            except OSError as error:
                _log.error("The history of tasks cannot be written: %s", error)

    def _append(self, line: str) -> None:
        count = len(self._lines()) if self._count is None else self._count
        if count < 2 * KEPT:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            opened = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
            with open(opened, "w", encoding="utf-8") as file:
                file.write(line + "\n")
            self._count = count + 1
            return
        foreign.write_private(self._path, "\n".join([*self._lines()[1 - KEPT :], line]) + "\n")
        self._count = KEPT

    def _lines(self) -> list[str]:
        try:
            return self._path.read_text(encoding="utf-8", errors="replace").splitlines()
        except FileNotFoundError:
            return []

    def newest(
        self, contains: str = "", *, tool: str = RUN_TASK, all_robots: bool = True
    ) -> list[PastTask]:
        """Past tasks, newest first, whose instruction contains all these words. Incomplete lines
        after a crash are left out.

        Args:
            contains: words.
            tool: only calls of this one; of all tools if empty.
            all_robots: of other robots than the present one too.

        Raises:
            OSError: the file cannot be read.
        """
        words, robot = contains.lower().split(), self.robot()
        found: list[PastTask] = []
        with self._lock:
            lines = self._lines()[-KEPT:]
        for line in reversed(lines):
            try:
                task = foreign.decode_model(PastTask, line, "a past task")
            except ForeignDataError:
                continue
            is_meant = tool in ("", task.tool) and (all_robots or task.robot in ("", robot))
            if is_meant and all(word in task.instruction.lower() for word in words):
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
            found = await context.run(
                lambda _: self.newest(arguments.contains, all_robots=arguments.all_robots)
            )
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
