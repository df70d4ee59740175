"""A warm switch during motion: every image is acted on once, and what fails changes nothing."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from switch_loop import Sent, Witness, moving_loop, quiet

from rn_testing.waiting import holds_within, wait_until
from roboneuron.errors import NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.selection.requests import StartChosenInference
from roboneuron.switching.replacing import Switching
from roboneuron.tools.loop.instructing import give_instruction

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(150)]


def change_overs(actions: list[Sent]) -> list[tuple[Sent, Sent]]:
    """The last action of one backend and the first of the next."""
    return [(a, b) for a, b in pairwise(actions) if a.tag != b.tag]


def check_turns(switching: Switching, witness: Witness) -> None:
    for backend in ("second", "first"):
        switched = switching.switch(
            "inference", StartChosenInference(backend=backend), "warm", quiet
        )
        assert switched.view.plan is not None
        assert switched.view.plan.names["backend"] == backend
        assert switched.view.report is not None
        assert switched.view.report.instruction == "move on"
        assert switched.change.gap is not None
        assert switched.change.difference is not None
        assert switched.change.difference < 0.01
    actions = witness.more_actions()
    changes = change_overs(actions)
    assert [b.tag for _, b in changes] == [2, 1]
    images = [action.image for action in actions]
    assert images == sorted(set(images)), "an image was acted on twice"
    # On a machine that is too busy for the rate, images are skipped all the time; a change-over
    # must not add to that.
    usual = max(b.image - a.image for a, b in pairwise(actions) if a.tag == b.tag)
    assert max(b.image - a.image for a, b in changes) <= usual


def test_every_image_is_acted_on_once_while_backends_take_turns_at_30_hz(tmp_path: Path) -> None:
    with moving_loop(tmp_path, 30.0) as (switching, witness):
        check_turns(switching, witness)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Switching, Witness]]:
    with moving_loop(tmp_path_factory.mktemp("loop"), 10.0) as made:
        yield made


@pytest.fixture
def cell(built: tuple[Switching, Witness]) -> tuple[Switching, Witness]:
    """The loop of the module with the first backend at work; the witness has seen nothing yet."""
    switching, witness = built
    choice = switching.loop.modules.view("inference").plan
    assert choice is not None
    assert choice.names["backend"] == "first"
    witness.forget()
    return built


def test_at_first_there_is_nothing_to_go_back_to(cell: tuple[Switching, Witness]) -> None:
    with pytest.raises(StateError, match="none was replaced"):
        cell[0].roll_back("inference", "warm")


def test_every_image_is_acted_on_once_while_backends_take_turns_at_10_hz(
    cell: tuple[Switching, Witness],
) -> None:
    check_turns(*cell)


def refused(
    switching: Switching,
    error: type[RoboNeuronError],
    on_stage: Callable[[str], None],
    halt: threading.Event | None = None,
    **options: object,
) -> str:
    """Message of a warm switch to "second" that must fail and leave the present process at work."""
    before = switching.loop.modules.view("inference").process
    request = StartChosenInference(backend="second", options=options)
    with pytest.raises(error) as caught:
        switching.switch("inference", request, "warm", on_stage, halt=halt)
    after = switching.loop.modules.view("inference")
    assert before is not None
    assert after.process is before
    assert after.phase == "running"
    return str(caught.value)


def test_what_fails_before_its_turn_changes_nothing(
    cell: tuple[Switching, Witness], tmp_path: Path
) -> None:
    switching, witness = cell
    loop = switching.loop
    text = refused(switching, RefusedError, quiet, offset_m=0.5)
    assert "differ by 0.5" in text
    assert "switch_max_difference" in text

    def kill_new(stage: str) -> None:
        if stage == "inference: changing over":
            (new,) = [slot.process for slot in loop.modules.slots["inference"][1:]]
            assert new is not None
            os.kill(new.pid, signal.SIGKILL)

    assert "signal 9" in refused(switching, NotReadyError, kill_new)

    for late in ("new inference: configuring", STAGES["comparing"]):
        halt = threading.Event()

        def cancel(stage: str, halt: threading.Event = halt, late: str = late) -> None:
            if stage == late:
                halt.set()

        assert "cancelled" in refused(switching, StateError, cancel, halt)
    (tmp_path / "fail").touch()
    assert "fell over" in refused(
        switching, RoboNeuronError, quiet, fail_file=str(tmp_path / "fail")
    )
    actions = witness.more_actions()
    assert {action.tag for action in actions} == {1}
    times = [action.at_ns for action in actions]
    assert max(b - a for a, b in pairwise(times)) < 0.5e9
    assert loop.modules.slots["inference"][1:] == []


SOON_S = 15.0
"""Half a second on an idle machine; what counts is that nobody waits for a time-out of 25 s or
more.
"""
STAGES = {
    "comparing": "new inference: comparing it in shadow with the old one",
    "handover": "inference: changing over",
}


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("which", ["old", "new"])
def test_a_process_that_freezes_ends_the_switch_at_once(
    cell: tuple[Switching, Witness], stage: str, which: str
) -> None:
    switching, witness = cell
    slots = switching.loop.modules.slots["inference"]
    frozen: list[int] = []
    at_s: list[float] = []

    def freeze(told: str) -> None:
        if told == STAGES[stage]:
            slot = slots[0 if which == "old" else 1]
            assert slot.process is not None
            frozen.append(slot.process.pid)
            at_s.append(time.monotonic())
            os.kill(slot.process.pid, signal.SIGSTOP)

    try:
        assert "frozen" in refused(switching, NotReadyError, freeze)
        assert time.monotonic() - at_s[0] < SOON_S
    finally:
        if which == "old":
            os.kill(frozen[0], signal.SIGCONT)
    witness.forget()
    if which == "old":  # as after every stop: it was frozen while it moved the arm
        assert not holds_within(lambda: len(witness.actions()) > 3, 1.0)
        give_instruction(switching.loop, "move on", 5.0)
    wait_until(lambda: len(witness.actions()) > 3, 10.0, "the old backend acts again")
    assert {action.tag for action in witness.more_actions()} == {1}
    assert len(slots) == 1


def test_what_does_not_act_when_its_turn_comes_gives_it_back(
    cell: tuple[Switching, Witness], tmp_path: Path
) -> None:
    switching, witness = cell
    hang = tmp_path / "hang"

    def hang_new(stage: str) -> None:
        if stage == "inference: changing over":
            hang.touch()

    assert "the old one acts again" in refused(
        switching, NotReadyError, hang_new, hang_file=str(hang)
    )
    assert {action.tag for action in witness.more_actions()} == {1}


def test_one_call_goes_back_and_a_cold_switch_says_its_gap(cell: tuple[Switching, Witness]) -> None:
    switching, witness = cell
    loop = switching.loop
    give_instruction(loop, "move further", 5.0)
    cold = switching.switch("inference", StartChosenInference(backend="second"), "cold", quiet)
    assert cold.change.gap is not None
    assert cold.change.gap.gap_s > 0.3
    back = switching.roll_back("inference", "warm")
    assert back.change.gap is not None
    assert back.change.gap.gap_s < min(0.3, cold.change.gap.gap_s)
    assert back.view.plan is not None
    assert back.view.plan.names["backend"] == "first"
    assert back.view.report is not None
    assert back.view.report.instruction == "move further"
    assert [b.tag for _, b in change_overs(witness.more_actions())] == [2, 1]
