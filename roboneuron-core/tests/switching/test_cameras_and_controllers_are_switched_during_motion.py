"""A change of the camera's source or of the controller while the arm moves; what fails changes
nothing.
"""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from switch_loop import Witness, moving_loop, quiet

from rn_testing.fakes import gantry_profile
from rn_testing.waiting import wait_until
from roboneuron.errors import (
    InvalidInputError,
    NotReadyError,
    RefusedError,
    RoboNeuronError,
    StateError,
)
from roboneuron.modules.settings import ModuleKind
from roboneuron.selection.requests import StartControl, StartPerception
from roboneuron.server.loop import ClosedLoop
from roboneuron.switching.replacing import Switching

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(150)]
RATE_HZ = 20.0


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Switching, Witness]]:
    with moving_loop(tmp_path_factory.mktemp("loop"), RATE_HZ) as made:
        yield made


@pytest.fixture
def cell(built: tuple[Switching, Witness]) -> tuple[Switching, Witness]:
    """The loop of the module with whatever the test before left at work; the witness has seen
    nothing yet.
    """
    built[1].forget()
    return built


def refused(
    loop: ClosedLoop, kind: ModuleKind, error: type[RoboNeuronError], switch: Callable[[], object]
) -> str:
    """Message of a switch that must fail and leave the present process at work."""
    before = loop.modules.view(kind).process
    with pytest.raises(error) as caught:
        switch()
    after = loop.modules.view(kind)
    assert before is not None
    assert after.process is before
    assert after.phase == "running"
    assert loop.modules.slots[kind][1:] == []
    return str(caught.value)


def test_at_first_there_is_nothing_to_go_back_to(cell: tuple[Switching, Witness]) -> None:
    with pytest.raises(StateError, match="no source to go back to"):
        cell[0].roll_back("perception", "warm")


def test_a_source_takes_over_between_two_images_and_gives_it_back(
    cell: tuple[Switching, Witness],
) -> None:
    switching, witness = cell
    witness.more_actions()
    switched = switching.switch("perception", StartPerception(source="other"), "warm")
    assert switched.view.plan is not None
    assert switched.view.plan.names["source"] == "other"
    assert switched.replaced["source"] == "numbering"
    gap = switched.change.gap
    assert gap is not None
    print(
        f"gap {gap.gap_s * 1e3:.0f} ms, period {gap.period_s * 1e3:.0f} ms, call "
        f"{switched.took_s:.1f} s"
    )
    assert gap.gap_s < 0.25
    back = switching.roll_back("perception", "warm")
    assert back.view.plan is not None
    assert back.view.plan.names["source"] == "numbering"
    actions = witness.more_actions()
    times = [action.at_ns / 1e9 for action in actions]
    assert max(b - a for a, b in pairwise(times)) < 0.5, "the backend was without images"
    cold = switching.switch("perception", StartPerception(source="other"), "cold")
    assert cold.change.gap is not None
    assert cold.change.gap.gap_s > gap.gap_s
    witness.more_actions()


def test_a_source_that_fails_leaves_the_old_one_at_work(
    cell: tuple[Switching, Witness], tmp_path: Path
) -> None:
    switching, witness = cell
    loop = switching.loop
    mode = tmp_path / "mode"

    def switch(on_stage: Callable[[str], None] = quiet, **options: object) -> Callable[[], object]:
        return lambda: switching.switch(
            "perception", StartPerception(source="other", options=options), "warm", on_stage
        )

    text = refused(loop, "perception", RefusedError, switch(scale=2))
    assert "'front'" in text
    assert "pixels large" in text

    def hang(stage: str) -> None:
        if stage == "perception: changing over":
            mode.write_text("hang")

    assert "the old one acts again" in refused(
        loop, "perception", NotReadyError, switch(hang, mode_file=str(mode))
    )
    mode.unlink()

    def kill(stage: str) -> None:
        if stage == "perception: changing over":
            (new,) = [slot.process for slot in loop.modules.slots["perception"][1:]]
            assert new is not None
            os.kill(new.pid, signal.SIGKILL)

    assert "signal 9" in refused(loop, "perception", NotReadyError, switch(kill))
    with pytest.raises(InvalidInputError, match="needs the camera front"):
        switching.switch("perception", StartPerception(source="other", cameras=["hand"]))
    witness.more_actions()


def test_a_controller_goes_on_from_the_last_command_of_the_old_one(
    cell: tuple[Switching, Witness],
) -> None:
    switching, witness = cell
    loop = switching.loop
    witness.more_actions(10)
    first = len(witness.commands())
    switched = switching.switch("control", StartControl(controller="faulty"), "warm")
    assert switched.view.plan is not None
    assert switched.view.plan.names["controller"] == "faulty"
    gap = switched.change.gap
    assert gap is not None
    assert switched.change.difference is not None
    print(
        f"gap {gap.gap_s * 1e3:.0f} ms, difference {switched.change.difference:.2g}, call "
        f"{switched.took_s:.1f} s"
    )
    assert switched.change.difference < 0.005
    assert gap.gap_s < 0.25
    back = switching.roll_back("control", "warm")
    assert back.view.plan is not None
    assert back.view.plan.names["controller"] == "gantry"
    witness.more_actions()
    commands = witness.commands()[first:]
    actions_ns = [action.at_ns for action in witness.actions() if action.at_ns > commands[0][0]]
    # that is the machine, not the switch
    without_actions_ns = max(b - a for a, b in pairwise(actions_ns))
    without_commands_ns = max(b[0] - a[0] for a, b in pairwise(commands))
    assert without_commands_ns < without_actions_ns + 0.3e9, "the arm was without commands"
    at_s, target_m = np.array([c[0] for c in commands]) / 1e9, np.array([c[1] for c in commands])
    steps_m_s = np.abs(np.diff(np.diff(target_m) / np.diff(at_s)))
    print(f"largest change of the commanded velocity: {steps_m_s.max():.3f} m/s")
    limits = gantry_profile().limits
    assert limits is not None
    # Times are those of sending, velocities those of targets: a late command makes one look slower,
    # the next faster.
    assert steps_m_s.max() < 2 * limits.acceleration[0] * np.diff(at_s).max()
    report = loop.modules.view("control").report
    assert report is not None
    assert report.dropped_by.get("holds", 0) == 0
    cold = switching.switch("control", StartControl(controller="faulty"), "cold")
    assert cold.change.gap is not None
    assert cold.change.gap.gap_s > gap.gap_s


def test_a_controller_that_differs_leaves_the_old_one_at_work(
    cell: tuple[Switching, Witness], tmp_path: Path
) -> None:
    switching, witness = cell
    loop = switching.loop
    mode = tmp_path / "mode"

    def switch(on_stage: Callable[[str], None] = quiet, **options: object) -> Callable[[], object]:
        return lambda: switching.switch(
            "control", StartControl(controller="faulty", options=options), "warm", on_stage
        )

    assert "TCP poses differ by 0.1 " in refused(loop, "control", RefusedError, switch(tool_m=0.1))
    text = refused(loop, "control", RefusedError, switch(offset=0.2))
    assert re.search(r"commands differ by 0\.(19|2)", text), text
    mode.write_text("hold")
    text = refused(loop, "control", RefusedError, switch(mode_file=str(mode)))
    assert "would hold where the running one moves the arm: doubt" in text
    mode.unlink()

    def hang(stage: str) -> None:
        if stage == "control: changing over":
            mode.write_text("hang")

    text = refused(loop, "control", NotReadyError, switch(hang, mode_file=str(mode)))
    assert "changed over" in text or "acts again" in text or "did not take its parameters" in text
    witness.more_actions()
    first = len(witness.commands())
    wait_until(lambda: len(witness.commands()) >= first + 5, 5.0, "the arm is commanded")


def test_a_controller_takes_over_an_arm_whose_policy_pauses_just_then(tmp_path: Path) -> None:
    """On a busy machine nothing may come for a second: the new one is not to blame for that, and
    holds the arm.
    """
    mode = tmp_path / "camera"

    def pause(stage: str) -> None:
        if stage == "control: changing over":
            mode.write_text("hang")

    with moving_loop(tmp_path, RATE_HZ, f'mode_file = "{mode}"') as (switching, witness):
        witness.more_actions(10)
        switched = switching.switch("control", StartControl(controller="faulty"), "warm", pause)
        assert switched.view.plan is not None
        assert switched.view.plan.names["controller"] == "faulty"
        mode.unlink()
        witness.more_actions()
        first = len(witness.commands())
        wait_until(lambda: len(witness.commands()) >= first + 5, 10.0, "the arm is commanded")
