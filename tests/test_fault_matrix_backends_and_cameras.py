"""Rows of the fault matrix: backends and cameras that fail while the arm moves, one loop for all of them."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from roboneuron.server.loop import ClosedLoop
from roboneuron.server.results import module_status
from roboneuron.supervisor.watch import assess

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from switch_loop import Witness, moving_loop

sys.path.pop(0)

pytestmark = [pytest.mark.ros, pytest.mark.timeout(150)]
HOLD_S = 0.5 + 0.5 + 0.5
"""max_image_age_s, then action_timeout_s, then what a busy machine adds."""


class Cell:
    """A gantry that follows a policy, and files that say what is wrong with policy and camera."""

    def __init__(self, loop: ClosedLoop, witness: Witness, folder: Path) -> None:
        self.loop, self.witness, self._folder = loop, witness, folder

    def fail(self, part: str, mode: str) -> None:
        """Make the "backend" or "camera" misbehave; an empty mode ends that."""
        path = self._folder / part
        temporary = path.with_suffix(".part")
        temporary.write_text(mode)
        temporary.replace(path)

    def health(self, kind: str) -> str:
        return assess(self.loop.supervisor.view(kind), time.monotonic())  # type: ignore[arg-type]

    def error(self, kind: str) -> str:
        failure = module_status(self.loop.supervisor.view(kind)).error  # type: ignore[arg-type]
        return failure.message if failure is not None else ""

    def moves(self) -> bool:
        return 0.0 < time.monotonic() - self._moved_s() < 0.4 and len(self.witness.actions()) > 0

    def _moved_s(self) -> float:
        return time.monotonic() - self.witness.stood_s()

    def stands(self) -> bool:
        return self.witness.stood_s() > 0.4


def wait_until(fact: Callable[[], bool], timeout_s: float, what: str) -> float:
    started_s = time.monotonic()
    while not fact():
        assert time.monotonic() - started_s < timeout_s, f"not within {timeout_s} s: {what}"
        time.sleep(0.01)
    return time.monotonic() - started_s


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder = tmp_path_factory.mktemp("faults")
    options = f'mode_file = "{folder}/camera"\n[plugins.first]\nmode_file = "{folder}/backend"\n'
    with moving_loop(folder, 10.0, camera_options=options) as (loop, witness):
        yield Cell(loop, witness, folder)


@pytest.fixture
def cell(built: Cell) -> Iterator[Cell]:
    """The loop, moving; what was made to fail is mended afterwards, and the arm moves again."""
    wait_until(built.moves, 10.0, "the arm moves")
    yield built
    for part in ("backend", "camera"):
        built.fail(part, "")
    wait_until(lambda: built.health("inference") == "ok", 10.0, "inference works again")
    wait_until(built.moves, 10.0, "the arm moves again")


def test_backend_that_raises_makes_the_arm_stand_and_is_quoted(cell: Cell) -> None:
    cell.fail("backend", "raise")
    wait_until(lambda: cell.health("inference") == "failing", 2.0, "the failure is in the status")
    assert "the model fell over" in cell.error("inference")
    wait_until(cell.stands, HOLD_S + 0.4, "the arm stands")
    assert cell.health("control") == "ok"


def test_backend_that_hangs_makes_the_arm_stand_and_counts_as_stalled(cell: Cell) -> None:
    cell.fail("backend", "hang")
    wait_until(lambda: cell.health("inference") == "stalled", 2.0, "the hang is in the status")
    wait_until(cell.stands, HOLD_S + 0.4, "the arm stands")
    sent = len(cell.witness.actions())
    time.sleep(0.3)  # what is looked for is that nothing happens
    assert len(cell.witness.actions()) == sent


def test_backend_that_answers_after_250_ms_goes_on(cell: Cell) -> None:
    cell.fail("backend", "250")
    before = len(cell.witness.actions())
    wait_until(lambda: len(cell.witness.actions()) > before + 5, 10.0, "it acts on")
    assert cell.moves()


def test_camera_that_repeats_its_image_makes_the_arm_stand(cell: Cell) -> None:
    cell.fail("camera", "frozen")
    wait_until(cell.stands, HOLD_S + 0.4, "the arm stands")
    wait_until(lambda: "No usable image" in cell.error("inference"), 3.0, "the status says so")


def test_camera_that_changes_its_size_is_an_error_and_the_arm_stands(cell: Cell) -> None:
    cell.fail("camera", "small")
    wait_until(cell.stands, HOLD_S + 0.4, "the arm stands")
    wait_until(lambda: cell.health("inference") == "failing", 3.0, "the status says so")
    assert "from 64x48 to 32x24" in cell.error("inference")


def test_black_images_are_the_backends_to_judge(cell: Cell) -> None:
    """Black is a valid image (a lens cap, a dark room): the loop goes on, nothing else fails."""
    cell.fail("camera", "black")
    wait_until(lambda: cell.witness.actions()[-1].image == 0, 5.0, "the backend sees it")
    assert cell.health("perception") == "ok"


@pytest.mark.parametrize("part", ["perception", "inference"])
def test_frozen_process_makes_the_arm_stand_and_goes_on_afterwards(cell: Cell, part: str) -> None:
    process = cell.loop.supervisor.slot(part).process  # type: ignore[arg-type]
    assert process is not None
    os.kill(process.pid, signal.SIGSTOP)
    try:
        assert wait_until(lambda: cell.health(part) == "silent", 2.0, "the status says so") < 0.5
        wait_until(cell.stands, HOLD_S + 0.4, "the arm stands")
    finally:
        os.kill(process.pid, signal.SIGCONT)


def test_backend_that_never_answers_is_ended_by_a_stop(built: Cell) -> None:
    wait_until(built.moves, 10.0, "the arm moves")
    built.fail("backend", "hang")
    wait_until(lambda: built.health("inference") == "stalled", 2.0, "the hang is in the status")
    started_s = time.monotonic()
    stopped = built.loop.stop("inference")
    assert stopped is not None
    assert time.monotonic() - started_s < 10.0
    assert not Path(f"/proc/{stopped.pid}").exists()
    assert built.stands()


def test_killed_perception_leaves_an_arm_that_stands(built: Cell) -> None:
    process = built.loop.supervisor.slot("perception").process
    assert process is not None
    process.kill()
    wait_until(lambda: built.health("perception") == "exited", 2.0, "the status says so")
    wait_until(built.stands, HOLD_S, "the arm stands")


def test_killed_robot_leaves_the_other_modules_at_work(built: Cell) -> None:
    process = built.loop.supervisor.slot("robot").process
    assert process is not None
    process.kill()
    wait_until(lambda: built.health("robot") == "exited", 2.0, "the status says so")
    assert built.health("control") in ("ok", "failing")
    assert [s.kind for s in built.loop.stop_all()] == ["control"]
