"""Past tasks: the history of run_task, and the pictures kept with it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set
from datetime import datetime
from pathlib import Path

from rn_standard.tasks.history import TaskHistory
from rn_view.sources.records import ShownTask

FOLDER = "task-pictures"
TASK_TOOL = "run_task"
KEPT = 200
"""Number of tasks whose pictures are kept. The history keeps as many."""


class PastTasks:
    """Past tasks and their pictures, in a state directory; thread-safe."""

    def __init__(self, state_directory: Path) -> None:
        self._history = TaskHistory(state_directory)
        self.folder = state_directory / FOLDER

    def newest(self) -> list[ShownTask]:
        """See PastTaskList."""
        places: Counter[int] = Counter()
        files = {path.name for path in self.folder.glob("*.jpg")}
        shown = []
        for task in reversed(self._history.newest()):
            at_s = _seconds(task.at)
            places[int(at_s)] += 1
            number = f"{int(at_s)}-{places[int(at_s)]}"
            shown.append(
                ShownTask(
                    number=number,
                    at_s=at_s,
                    instruction=task.instruction,
                    outcome=task.outcome,
                    reason=task.reason,
                    attempts=task.attempts,
                    took_s=task.took_s,
                    model=", ".join(f"{key} {value}" for key, value in task.model.items()),
                    pictures=(f"{number}-start.jpg" in files, f"{number}-end.jpg" in files),
                )
            )
        return shown[::-1]

    def picture(self, number: str, *, is_end: bool) -> bytes | None:
        """See PastTaskList."""
        first, _, second = number.partition("-")
        if not (first.isdecimal() and second.isdecimal()):
            return None
        try:
            return self._path(number, is_end).read_bytes()
        except OSError:
            return None

    def keep(
        self, instruction: str, before: Set[str], first: bytes | None, last: bytes | None
    ) -> None:
        """Store the pictures of a task that has ended, and delete the oldest pictures.

        Args:
            instruction: instruction of the task.
            before: numbers of the tasks before it. If no other task has this instruction, the call
                made no task, as a simulated or a refused call, and nothing is stored.
            first, last: JPEG of the start and the end, if any.
        """
        words = instruction.strip()
        tasks = (one for one in self.newest() if one.number not in before)
        task = next((one for one in tasks if one.instruction.strip() == words), None)
        if task is None:
            return
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for data, is_end in ((first, False), (last, True)):
            if data is not None:
                self._path(task.number, is_end).write_bytes(data)
        kept = sorted(self.folder.glob("*.jpg"), key=lambda path: path.stat().st_mtime)
        for path in kept[: -2 * KEPT]:
            path.unlink(missing_ok=True)

    def _path(self, number: str, is_end: bool) -> Path:
        return self.folder / f"{number}-{'end' if is_end else 'start'}.jpg"


def _seconds(text: str) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except ValueError:
        return 0.0
