"""Past tasks for the page: the history of run_task, pictures of their beginnings and ends, and
rates of success.
"""

from __future__ import annotations

import io
import logging
import math
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rn_standard.tasks.history import TaskHistory
from rn_view.sources.records import ShownTask
from roboneuron import CallContext, RoboNeuronError, Tool, frame_from_buffer

if TYPE_CHECKING:
    from sensor_msgs.msg import Image

log = logging.getLogger(__name__)
FOLDER = "task-pictures"
TASK_TOOL = "run_task"
KEPT = 200
"""Tasks of which pictures are kept, as many as the history keeps."""
_WIDTH_PX, _QUALITY = 320, 75
_PICTURE_S = 2.0
"""Longest wait for a picture of the camera."""
_Z = 1.959964
"""97.5th percentile of the standard normal distribution."""
_JUDGED = ("succeeded", "failed", "timed_out")
"""Outcomes that say something of a model; a person or a stop ended the others."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SuccessRate:
    """How often a model succeeded with one instruction.

    Attributes:
        model, instruction: as of the tasks.
        succeeded, judged: tasks that ended by themselves; stopped, taken-over and unclear ones are
            in neither.
        low, high: 95 % Wilson score interval of the proportion.
        median_s: of the successful ones [s]; None without any.
    """

    model: str
    instruction: str
    succeeded: int
    judged: int
    low: float
    high: float
    median_s: float | None


def success_rates(tasks: Sequence[ShownTask]) -> list[SuccessRate]:
    """Rates by model and words, those with the most tasks first.

    Source of the interval: E. B. Wilson, J. Am. Stat. Assoc. 22 (1927), 209.
    """
    groups: dict[tuple[str, str], list[ShownTask]] = {}
    for task in tasks:
        if task.outcome in _JUDGED:
            words = " ".join(task.instruction.lower().split())
            groups.setdefault((task.model, words), []).append(task)
    rates = []
    for (model, words), found in groups.items():
        good = [task.took_s for task in found if task.outcome == "succeeded"]
        low, high = _wilson(len(good), len(found))
        rates.append(
            SuccessRate(
                model=model,
                instruction=words,
                succeeded=len(good),
                judged=len(found),
                low=low,
                high=high,
                median_s=float(np.median(good)) if good else None,
            )
        )
    return sorted(rates, key=lambda rate: rate.judged, reverse=True)


class PastTasks:
    """Tasks and pictures in a state directory; thread-safe."""

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
        """Keep pictures of a task that has ended, and delete the oldest of others.

        Args:
            instruction: its words.
            before: numbers of the tasks before it. If no other has these words, the call was no
                task, such as a preview or one that was refused, and nothing is kept.
            first, last: JPEG, if there is one.
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


class Camera(Protocol):
    """Calls a function with each picture of the main camera; returns what ends that."""

    def __call__(self, on_image: Callable[[Image], None]) -> Callable[[], None]: ...


@dataclass(slots=True)
class _Begun:
    """A call of run_task: numbers of the tasks before it, and its first picture as JPEG."""

    before: set[str] = field(default_factory=set)
    picture: bytes | None = None


class TaskPictures:
    """Takes a picture when a task begins and when it ends, each on a thread of its own; nothing is
    subscribed to in between.

    Args:
        tasks: where they go.
        camera: of the robot; None without one.
    """

    def __init__(self, tasks: PastTasks, camera: Callable[[], Camera | None]) -> None:
        self._tasks, self._camera = tasks, camera
        self._begun = _Begun()
        self._threads: list[threading.Thread] = []

    def admit(self, tool: Tool[Any], context: CallContext) -> None:
        """Look at a call that begins; refuses nothing."""
        if tool.name == TASK_TOOL:
            begun = self._begun = _Begun()
            self._start(lambda: self._begin(begun))

    def on_call(
        self, tool: str, arguments: Mapping[str, Any], who: str, code: str, took_s: float
    ) -> None:
        """Listener of `Events.call`."""
        if tool == TASK_TOOL:
            begun, instruction = self._begun, str(arguments.get("instruction", ""))
            self._start(lambda: self._finish(instruction, begun))

    def join(self, timeout_s: float) -> None:
        """Wait for pictures that are being taken."""
        for thread in self._threads:
            thread.join(timeout_s)

    def _start(self, work: Callable[[], object]) -> None:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        thread = threading.Thread(target=work, name="view-task-picture", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _begin(self, begun: _Begun) -> None:
        begun.before.update(task.number for task in self._tasks.newest())
        begun.picture = self._take()

    def _finish(self, instruction: str, begun: _Begun) -> None:
        last = self._take()
        try:
            self._tasks.keep(instruction, begun.before, begun.picture, last)
        except OSError as error:
            log.error("Pictures of a task cannot be kept: %s", error)

    def _take(self) -> bytes | None:
        """One picture as JPEG; None when none comes."""
        found: list[Image] = []
        news = threading.Event()

        def take(message: Image) -> None:
            if not found:
                found.append(message)
            news.set()

        try:
            camera = self._camera()
            if camera is None:
                return None
            end = camera(take)
            try:
                news.wait(_PICTURE_S)
            finally:
                end()
            return jpeg(found[0]) if found else None
        except (RoboNeuronError, ValueError) as error:
            log.warning("A task has no picture: %s", error)
            return None


def jpeg(message: Image) -> bytes:
    """An image message as a JPEG of at most 320 px of width."""
    from PIL import Image as Pillow  # heavy

    pixels: NDArray[np.uint8] = frame_from_buffer(
        message.data,
        width=message.width,
        height=message.height,
        step=message.step,
        encoding=message.encoding,
    )
    picture = Pillow.fromarray(np.ascontiguousarray(pixels))
    picture.thumbnail((_WIDTH_PX, _WIDTH_PX * 4))
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=_QUALITY)
    return out.getvalue()


def _seconds(text: str) -> float:
    try:
        return datetime.fromisoformat(text).timestamp()
    except ValueError:
        return 0.0


def _wilson(good: int, total: int) -> tuple[float, float]:
    share, z2 = good / total, _Z * _Z
    centre = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = _Z * math.sqrt(share * (1 - share) / total + z2 / (4 * total * total)) / (1 + z2 / total)
    return max(0.0, centre - half), min(1.0, centre + half)
