"""A picture when a task begins and one when it ends; nothing is subscribed to in between."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import anyio
import numpy as np
import pytest
from view_fakes import picture

from rn_standard.tasks.history import TaskHistory
from rn_view.tasks import past_tasks, task_pictures
from rn_view.tasks.past_tasks import PastTasks
from rn_view.tasks.task_pictures import TaskPictures
from roboneuron import CallContext, NotReadyError
from roboneuron.server.interception import IncomingCall
from roboneuron.server.tool import Answer

pytestmark = pytest.mark.ros


class Cell:
    """A camera that sends one picture to whoever subscribes."""

    def __init__(self, folder: Path) -> None:
        self.shade: int | None = 10
        self.open = 0
        self.tasks = PastTasks(folder)
        self.history = TaskHistory(folder)
        self.pictures = TaskPictures(self.tasks, lambda: self.camera)

    def camera(self, on_image: Callable[[Any], None]) -> Callable[[], None]:
        self.open += 1
        if self.shade is not None:
            on_image(picture(self.shade))
            on_image(picture(255))

        def end() -> None:
            self.open -= 1

        return end

    def run(self, words: str, ends_with: int | None = 200, *, is_task: bool = True) -> None:
        async def carry_out(call: IncomingCall) -> Answer:
            self.pictures.join(10.0)
            assert self.open == 0
            self.shade = ends_with
            if is_task:
                self.history.note(words, "succeeded", "")
            return Answer(structured={})

        call = IncomingCall(
            name="run_task",
            arguments={"instruction": words},
            context=cast(CallContext, SimpleNamespace()),
            found=None,
        )
        anyio.run(self.pictures.around, call, carry_out)
        self.pictures.join(10.0)
        assert self.open == 0

    def shade_of(self, number: str, *, is_end: bool) -> int:
        from PIL import Image

        data = self.tasks.picture(number, is_end=is_end)
        assert data is not None
        return int(np.asarray(Image.open(io.BytesIO(data))).mean())


@pytest.fixture
def cell(tmp_path: Path) -> Cell:
    return Cell(tmp_path)


def test_a_task_is_shown_as_it_began_and_as_it_ended(cell: Cell) -> None:
    cell.run("pick up")
    (task,) = cell.tasks.newest()
    assert task.pictures == (True, True)
    assert abs(cell.shade_of(task.number, is_end=False) - 10) <= 2
    assert abs(cell.shade_of(task.number, is_end=True) - 200) <= 2


def test_a_call_that_is_no_task_leaves_the_pictures_of_the_one_before(cell: Cell) -> None:
    """A call that was refused."""
    cell.run("pick up")
    cell.shade = 90
    cell.run("pick up", ends_with=120, is_task=False)
    (task,) = cell.tasks.newest()
    assert abs(cell.shade_of(task.number, is_end=False) - 10) <= 2
    assert abs(cell.shade_of(task.number, is_end=True) - 200) <= 2


def test_a_camera_that_is_silent_or_cannot_be_asked_leaves_a_task_without(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(task_pictures, "_PICTURE_S", 0.05)
    cell.run("pick up", ends_with=None)

    def refuse(on_image: Callable[[Any], None]) -> Callable[[], None]:
        raise NotReadyError("no ROS")

    monkeypatch.setattr(cell, "camera", refuse)
    cell.run("put down")
    assert [task.pictures for task in cell.tasks.newest()] == [(False, False), (True, False)]


def test_pictures_are_bounded(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(past_tasks, "KEPT", 2)
    for number in range(4):
        cell.run(f"task {number}")
    assert len(list(cell.tasks.folder.glob("*.jpg"))) == 4
