"""Rows of the fault matrix: backends, cameras, clocks, joint states and processes that fail while
the arm moves.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from fault_loop import PARTS, JointWitness, fail, moving_cell

from rn_standard.fastdds.segments import PORT_PREFIX, SHARED_MEMORY, owned_segments
from rn_standard.ops.memory import MemoryWatch
from rn_standard.ops.options import MemoryOptions
from rn_testing.waiting import wait_until
from roboneuron.selection.requests import StartChosenInference
from roboneuron.server.loop import ClosedLoop
from roboneuron.supervisor.health import Watch
from roboneuron.tools.loop.instructing import give_instruction
from roboneuron.tools.loop.results import ModuleStatus

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(150)]
MEMORY_LIMIT_MB = 400
HOLD_S = 0.5 + 0.5 + 0.5
"""max_image_age_s, then action_timeout_s, then a margin for a busy machine."""
SERVER_TIMEOUT = "server_timeout_s = 20.0"
"""A busy machine reaches the default of 2 s, after which the arm would rightly require a new start.
"""
STATE_HOLD_S = 0.25 + 0.1 + 0.5
"""state_timeout_s, detected within a fifth of action_timeout_s, then a margin for a busy
machine.
"""


class Cell:
    """A gantry that follows a policy, and files that control faults of its parts."""

    def __init__(self, loop: ClosedLoop, witness: JointWitness, folder: Path) -> None:
        self.loop, self.witness, self._folder = loop, witness, folder
        self.moves, self.stands = witness.moves, witness.stands

    def fail(self, part: str, mode: str) -> None:
        """Make one of `PARTS` misbehave; an empty mode ends that."""
        fail(self._folder, part, mode)

    def status(self, kind: str) -> ModuleStatus:
        """Status from get_status."""
        return ModuleStatus.of(self.loop.modules.view(kind))  # type: ignore[arg-type]

    def health(self, kind: str) -> str:
        return self.status(kind).health

    def error(self, kind: str) -> str:
        failure = self.status(kind).error
        return failure.message if failure is not None else ""

    def hold_code(self) -> str:
        return self.status("control").metrics.get("hold_code", "")

    def dropped(self, kind: str, word: str) -> int:
        return self.status(kind).dropped_by.get(word, 0)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder = tmp_path_factory.mktemp("faults")
    more = {"robot": SERVER_TIMEOUT, "control": SERVER_TIMEOUT}
    with moving_cell(folder, 10.0, **more) as (loop, witness):
        yield Cell(loop, witness, folder)


@pytest.fixture
def cell(built: Cell) -> Iterator[Cell]:
    """The moving loop; faults are cleared afterwards, and the arm moves again."""
    wait_until(built.moves, 10.0, "the arm moves")
    yield built
    for part in PARTS:
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
    sent = cell.witness.actions()
    time.sleep(0.3)  # to show that nothing happens
    assert cell.witness.actions() == sent


def test_backend_that_answers_after_250_ms_goes_on(cell: Cell) -> None:
    cell.fail("backend", "250")
    before = cell.witness.actions()
    wait_until(lambda: cell.witness.actions() > before + 5, 10.0, "it acts on")
    wait_until(cell.moves, 0.6, "the arm moves on")


def test_backend_that_answers_after_two_seconds_does_not_move_the_arm(cell: Cell) -> None:
    """By then its image is older than max_image_age_s and no longer valid."""
    cell.fail("backend", "2000")
    wait_until(cell.stands, HOLD_S + 0.4, "the arm stands")
    sent = cell.witness.actions()
    before = cell.dropped("inference", "late_action")
    wait_until(
        lambda: cell.dropped("inference", "late_action") > before,
        6.0,
        "the answer is counted as late",
    )
    wait_until(
        lambda: "The image behind row 1 of 1 was 2." in cell.error("inference"),
        2.0,
        "the status says so",
    )
    assert cell.witness.actions() == sent
    assert cell.stands()


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
    """Black is a valid image (a lens cap, a dark room): the loop continues, and nothing else
    fails.
    """
    cell.fail("camera", "black")
    wait_until(lambda: cell.witness.newest_image == 0, 5.0, "the backend sees it")
    assert cell.health("perception") == "ok"


@pytest.mark.parametrize("part", ["perception", "inference"])
def test_frozen_process_makes_the_arm_stand_until_somebody_asks_for_motion(
    cell: Cell, part: str
) -> None:
    process = cell.loop.modules.view(part).process  # type: ignore[arg-type]
    assert process is not None
    with closing(Watch(cell.loop.starts.look, lambda *_: None)) as watch:
        watch.start()
        os.kill(process.pid, signal.SIGSTOP)
        try:
            took_s = wait_until(lambda: cell.health(part) == "silent", 2.0, "the status says so")
            assert took_s < 0.5
            wait_until(cell.stands, HOLD_S + 0.4, "the arm stands")
            assert cell.loop.starts.reason == f"{part} is frozen (SIGSTOP or a debugger)"
        finally:
            os.kill(process.pid, signal.SIGCONT)
        wait_until(lambda: cell.health(part) != "silent", 10.0, "it works again")
        time.sleep(1.0)  # to show that nothing happens
        assert cell.stands()
    give_instruction(cell.loop, "move on", 10.0)


@pytest.mark.parametrize(
    "fault", ["stale", "future", "frozen", "missing-joint", "unknown-names", "nan", "stamps-10"]
)
def test_joint_states_that_cannot_be_true_make_the_arm_stand(cell: Cell, fault: str) -> None:
    before = cell.dropped("control", "bad_joint_state")
    cell.fail("gantry", fault)
    wait_until(cell.stands, STATE_HOLD_S + 0.4, "the arm stands")
    wait_until(lambda: cell.hold_code() == "stale_joint_state", 2.0, "the status says why")
    assert fault == "frozen" or cell.dropped("control", "bad_joint_state") > before
    assert cell.health("robot") == "ok"


def test_joint_states_out_of_order_do_not_bring_an_old_posture_back(cell: Cell) -> None:
    """Every second one is 0.1 s older and 50 mm away: those are counted, and the arm moves on with
    the others.
    """
    before, since_s = cell.dropped("control", "bad_joint_state"), time.monotonic()
    cell.fail("gantry", "reordered")
    wait_until(
        lambda: cell.dropped("control", "bad_joint_state") > before + 10,
        3.0,
        "the older ones are counted",
    )
    wait_until(cell.moves, 0.3, "the arm moves on")
    assert cell.witness.largest_step_m(since_s) < 0.02


@pytest.mark.parametrize("jump_s", ["+0.2", "-0.2"])
def test_robot_whose_stamps_jump_a_little_stops_for_one_timeout_only(
    cell: Cell, jump_s: str
) -> None:
    since_s = time.monotonic()
    cell.fail("gantry", f"stamps{jump_s}")
    time.sleep(STATE_HOLD_S)  # to show what comes after it
    wait_until(cell.moves, 2.0, "the arm moves again")
    assert cell.witness.largest_step_m(since_s) < 0.02


@pytest.mark.parametrize(
    ("part", "mode", "kind", "word"),
    [
        ("camera_clock", "10", "inference", "future_image"),
        ("camera_clock", "-10", "inference", "old_image"),
        ("gantry", "control-clock+10", "control", "stale_action"),
        ("gantry", "control-clock-10", "control", "future_action"),
        ("gantry", "robot-clock+10", "robot", "stale_command"),
        ("gantry", "robot-clock-10", "robot", "future_command"),
    ],
)
def test_clock_that_jumps_makes_the_arm_stand_until_it_is_right(
    cell: Cell, part: str, mode: str, kind: str, word: str
) -> None:
    before = cell.dropped(kind, word)
    cell.fail(part, mode)
    wait_until(cell.stands, HOLD_S + 0.4, "the arm stands")
    wait_until(
        lambda: cell.dropped(kind, word) > before, 2.0, "the status counts what was not believed"
    )


def test_robot_process_that_is_frozen_needs_a_new_start_and_does_not_jump(cell: Cell) -> None:
    process = cell.loop.modules.view("robot").process
    assert process is not None
    since_s = time.monotonic()
    os.kill(process.pid, signal.SIGSTOP)
    try:
        assert wait_until(lambda: cell.health("robot") == "silent", 2.0, "the status says so") < 0.5
        wait_until(lambda: cell.hold_code() == "stale_joint_state", 2.0, "control sends nothing")
        time.sleep(1.0)  # the policy's requests of this time must not all be executed at once
    finally:
        os.kill(process.pid, signal.SIGCONT)
    wait_until(
        lambda: cell.status("robot").needs_start == "the robot process was frozen",
        5.0,
        "the status says why it keeps still",
    )
    assert cell.witness.largest_step_m(since_s) < 0.005
    give_instruction(cell.loop, "move on", 10.0)
    wait_until(cell.moves, 5.0, "the arm moves again")
    assert cell.witness.largest_step_m(since_s) < 0.005


def test_plugin_that_eats_memory_is_ended_and_the_arm_stands(cell: Cell) -> None:
    told: list[tuple[str, str]] = []
    watch = MemoryWatch(
        cell.loop.modules,
        MemoryOptions(inference=MEMORY_LIMIT_MB),
        lambda kind, why: told.append((kind, why)),
    )
    watch.start()
    cell.fail("memory", "eat")
    try:
        wait_until(lambda: cell.health("inference") == "exited", 10.0, "the process is ended")
    finally:
        watch.close()
    wait_until(cell.stands, HOLD_S, "the arm stands")
    assert [kind for kind, _ in told] == ["inference"]
    assert f"[ops.memory_limit_mb] inference = {MEMORY_LIMIT_MB} are allowed" in told[0][1]
    exited = cell.status("inference").exit
    assert exited is not None
    assert any("memory_limit_mb" in line for line in exited.last_lines)
    assert {cell.health(kind) for kind in ("robot", "perception", "control")} == {"ok"}
    cell.fail("memory", "")
    cell.loop.start("inference", StartChosenInference(instruction="move on"))


def test_module_whose_port_has_lost_its_file_hears_its_new_neighbour(cell: Cell) -> None:
    """The remains of a process that is killed in the middle of a message (see
    `rn_standard.fastdds.lost_ports`).
    """
    cell.loop.stop("perception")
    process = cell.loop.modules.view("inference").process
    assert process is not None
    ports = [name for name in owned_segments(process.pid) if name.startswith(PORT_PREFIX)]
    for name in ports:
        (SHARED_MEMORY / name).unlink()
    cell.loop.start("perception")
    wait_until(lambda: cell.health("inference") != "failing", 10.0, "inference hears it")
    # stopping a module ended the request
    give_instruction(cell.loop, "move on", 10.0)
    wait_until(cell.moves, 10.0, "the arm moves")
    wait_until(
        lambda: all((SHARED_MEMORY / name).exists() for name in ports),
        3.0,
        "its other port is found as well",
    )


def test_backend_that_never_answers_is_ended_by_a_stop(built: Cell) -> None:
    wait_until(built.moves, 10.0, "the arm moves")
    built.fail("backend", "hang")
    wait_until(lambda: built.health("inference") == "stalled", 2.0, "the hang is in the status")
    started_s = time.monotonic()
    stopped = built.loop.stop("inference")
    assert time.monotonic() - started_s < 10.0
    assert not Path(f"/proc/{stopped.pid}").exists()
    assert built.stands()


def test_killed_perception_leaves_an_arm_that_stands(built: Cell) -> None:
    process = built.loop.modules.view("perception").process
    assert process is not None
    process.kill()
    wait_until(lambda: built.health("perception") == "exited", 2.0, "the status says so")
    wait_until(built.stands, HOLD_S, "the arm stands")


def test_killed_robot_leaves_the_other_modules_at_work(built: Cell) -> None:
    process = built.loop.modules.view("robot").process
    assert process is not None
    process.kill()
    wait_until(lambda: built.health("robot") == "exited", 2.0, "the status says so")
    assert built.health("control") in ("ok", "failing")
    assert [s.module for s in built.loop.stop_all()] == ["control"]
