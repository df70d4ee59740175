"""Pictures of the main camera at the start and end of each task."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from rn_view.page import picture_stream
from rn_view.tasks.past_tasks import PastTasks
from roboneuron import RoboNeuronError, image_from_message
from roboneuron.feature import Answer, IncomingCall, Proceed

if TYPE_CHECKING:
    from sensor_msgs.msg import Image

log = logging.getLogger(__name__)
_WIDTH_PX, _QUALITY = 320, 75
_PICTURE_S = 2.0
"""Longest wait for a picture of the camera."""


class Camera(Protocol):
    """Calls a function with each image of the main camera; returns a function that ends this."""

    def __call__(self, on_image: Callable[[Image], None]) -> Callable[[], None]: ...


@dataclass(slots=True)
class _Begun:
    """A call of run_task that has started.

    Attributes:
        before: numbers of the tasks before it.
        picture: JPEG of its start, if any.
    """

    before: set[str] = field(default_factory=set)
    picture: bytes | None = None


class TaskPictures:
    """Takes a picture when a task starts and when it ends, each in its own thread. Nothing is
    subscribed to in between.

    Args:
        tasks: stores the pictures.
        camera: returns the main camera; None if the robot has none.
    """

    def __init__(self, tasks: PastTasks, camera: Callable[[], Camera | None]) -> None:
        self._tasks, self._camera = tasks, camera
        self._threads: list[threading.Thread] = []

    async def around(self, call: IncomingCall, proceed: Proceed) -> Answer:
        """Take the pictures of a call of run_task that nothing has refused, see `Interceptor`."""
        begun = _Begun()
        self._start(lambda: self._begin(begun))
        instruction = str(call.arguments.get("instruction", ""))
        try:
            answer = await proceed(call)
        except RoboNeuronError:
            self._start(lambda: self._finish(instruction, begun))
            raise
        self._start(lambda: self._finish(instruction, begun))
        return answer

    def join(self, timeout_s: float) -> None:
        """Wait for the pictures being taken, at most `timeout_s` for each."""
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
            log.error("Cannot store the pictures of a task: %s", error)

    def _take(self) -> bytes | None:
        """Take one picture as JPEG; None if no image arrives in time."""
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
            log.warning("Cannot take a picture of a task: %s", error)
            return None


def jpeg(message: Image) -> bytes:
    """Encode an image message as JPEG, at most 320 px wide."""
    return picture_stream.jpeg(image_from_message(message), _WIDTH_PX, _QUALITY)
