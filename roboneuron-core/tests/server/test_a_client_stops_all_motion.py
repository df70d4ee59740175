"""A client's stop of all motion, with a supervisor without processes."""

from __future__ import annotations

from typing import Any, cast

import pytest
from starts_machine import Machine

from roboneuron.estop.motion_starts import MotionStarts


@pytest.fixture
def machine() -> Machine:
    return Machine()


@pytest.fixture
def starts(machine: Machine) -> MotionStarts:
    made = MotionStarts(cast(Any, machine))
    made.look(False)
    return made


def test_a_client_s_stop_reaches_every_module_that_moves(
    machine: Machine, starts: MotionStarts
) -> None:
    starts.give("pick it up", 1.0)
    assert starts.stop_motion("a client called stop_motion") == dict.fromkeys(
        ("robot", "control", "inference"), ""
    )
    assert {kind: machine[kind].needs_start for kind in ("robot", "control")} == dict.fromkeys(
        ("robot", "control"), "a client called stop_motion"
    )
    assert (starts.instruction, machine["inference"].instruction) == ("", "")
    starts.permit(starts.arm_stops)
    assert not machine["control"].needs_start, "the next request is obeyed"


@pytest.mark.parametrize("kind", ["robot", "control"])
def test_a_module_that_does_not_confirm_a_client_s_stop_is_named(
    machine: Machine, starts: MotionStarts, kind: str
) -> None:
    machine[kind].hangs = True
    failures = starts.stop_motion("a client called stop_motion")
    assert [one for one, why in failures.items() if why] == [kind]


def test_a_policy_that_does_not_confirm_a_client_s_stop_is_ended(
    machine: Machine, starts: MotionStarts
) -> None:
    machine["inference"].hangs = True
    assert not any(starts.stop_motion("a client called stop_motion").values())
    assert machine["inference"].ended


def test_a_policy_that_is_started_with_an_instruction_is_not_started(
    machine: Machine, starts: MotionStarts
) -> None:
    starts.begin("pick it up")
    cancelled: list[str] = []
    slot = machine.slots["inference"][0]
    slot.phase, slot.cancel = "starting", cancelled.append
    starts.stop_motion("a client called stop_motion")
    assert cancelled == ["a client called stop_motion"]
