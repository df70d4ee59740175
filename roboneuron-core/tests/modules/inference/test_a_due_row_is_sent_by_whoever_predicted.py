"""The first row of an answer is sent on the thread that predicted it; what silences the player
silences that thread too.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import ActionChunk, Observation
from roboneuron.errors import NotReadyError
from roboneuron.modules.inference.execution import Bounds, ChunkExecutor, Row
from roboneuron.modules.inference.player import RowPlayer
from roboneuron.modules.status import StatusWriter
from roboneuron.modules.step_filters import StepFilter, StepFilters

STEP_S = 30.0
"""The player's thread waits for that long after the first row: it sends no other one."""


class Turn(StepFilter):
    """Lets rows be sent while they are the cell's."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell

    def may_play(self, now_ns: int) -> bool:
        return self._cell.is_ours


class Cell:
    """An executor and its player, which notes who sent which row."""

    def __init__(self, resources: contextlib.ExitStack) -> None:
        self.sent: list[tuple[int, str]] = []
        self.is_ours = True
        self.status = StatusWriter("inference")
        self.node: Any = SimpleNamespace(
            resources=resources,
            status=self.status,
            now_ns=time.time_ns,
            stopped=False,
        )
        self.executor = ChunkExecutor(Bounds(first_s=1.0))
        self.player = RowPlayer(self.node, StepFilters([Turn(self)]), self.executor, self._send)
        self.stop = threading.Event()

    def _send(self, row: Row) -> None:
        self.sent.append((row.index, threading.current_thread().name))

    def answer(self, age_s: float = 0.0) -> None:
        """As the thread that predicted does, with an answer to an image of that age."""
        stamp_ns = time.time_ns() - int(age_s * 1e9)
        observation = Observation(
            frames={},
            instruction="go",
            joints=None,
            ee_pose=None,
            gripper_open=None,
            stamp_ns=stamp_ns,
        )
        chunk = ActionChunk(actions=np.zeros((3, 7)), step_s=STEP_S)
        with self.executor.changed:
            prediction = self.executor.begin(observation, stamp_ns)
            self.executor.answer(prediction, chunk, time.time_ns())
            self.player.play_due(self.stop)


@pytest.fixture
def cell() -> Iterator[Cell]:
    with contextlib.ExitStack() as resources:
        yield Cell(resources)


def test_the_first_row_is_sent_at_once_and_the_next_one_when_it_is_due(cell: Cell) -> None:
    cell.player.start()
    cell.answer()
    assert cell.sent == [(0, "MainThread")]
    cell.player.play_due(cell.stop)
    assert cell.sent == [(0, "MainThread")]


def test_nothing_is_sent_before_a_start_or_after_a_stop(cell: Cell) -> None:
    cell.answer()
    assert cell.sent == []
    cell.executor.begin_epoch()
    cell.player.start()
    cell.player.stop()
    cell.answer()
    assert cell.sent == []


@pytest.mark.parametrize("what", ["emergency stop", "end of the work"])
def test_what_silences_the_player_drops_the_rows(cell: Cell, what: str) -> None:
    cell.player.start()
    if what == "emergency stop":
        cell.node.stopped = True
    else:
        cell.stop.set()
    cell.answer()
    assert cell.sent == []
    assert cell.executor.due_s() is None


def test_a_successor_waits_until_the_predecessor_has_finished(cell: Cell) -> None:
    cell.is_ours = False
    cell.player.start()
    cell.answer()
    assert cell.sent == []
    cell.is_ours = True
    deadline_s = time.monotonic() + 10.0
    while not cell.sent and time.monotonic() < deadline_s:
        time.sleep(0.005)
    assert cell.sent == [(0, "playing")]


def test_an_answer_to_an_old_image_is_refused_and_counted(cell: Cell) -> None:
    cell.player.start()
    with pytest.raises(NotReadyError, match="max_image_age_s"):
        cell.answer(age_s=1.5)
    assert cell.sent == []
    assert dict(cell.status.dropped) == {"late_action": 1}
