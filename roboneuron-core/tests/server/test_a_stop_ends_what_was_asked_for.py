"""The server's state of stops and instructions, with a supervisor without processes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, cast

import pytest
from starts_machine import SILENCE_S, Machine, Process, Slot

from roboneuron.errors import NotReadyError, RefusedError, StateError
from roboneuron.estop.motion_starts import MotionStarts
from roboneuron.modules.settings import (
    ARM_KINDS,
    MODULE_KINDS,
)


@pytest.fixture
def machine() -> Machine:
    return Machine()


@pytest.fixture
def starts(machine: Machine) -> MotionStarts:
    made = MotionStarts(cast(Any, machine))
    made.look(False)
    return made


def kill(machine: Machine, kind: str) -> None:
    machine.slots[kind][0].phase, machine[kind].exit_code = "exited", -9


def freeze(machine: Machine, kind: str) -> None:
    machine[kind].frozen = machine[kind].hangs = True


Lose = Callable[[Machine, str], None]
LOSSES: dict[str, tuple[Lose, str]] = {
    "killed": (kill, "has ended by itself (signal 9)"),
    "frozen": (freeze, "is frozen (SIGSTOP or a debugger)"),
}
lost = pytest.mark.parametrize(("lose", "loss"), LOSSES.values(), ids=LOSSES)


@lost
@pytest.mark.parametrize("kind", MODULE_KINDS)
def test_a_lost_module_ends_what_was_asked_for_by_its_name(
    machine: Machine, starts: MotionStarts, kind: str, lose: Lose, loss: str
) -> None:
    machine.pass_time(starts, 1.0)
    starts.give("pick it up", 1.0)
    lose(machine, kind)
    machine.pass_time(starts, SILENCE_S + 0.5, kind)
    assert starts.reason == f"{kind} {loss}"
    assert (starts.stops, starts.arm_stops) == (1, int(kind in ARM_KINDS)), "once"
    assert starts.instruction == ""
    assert kind == "inference" or machine["inference"].instruction == ""


@lost
@pytest.mark.parametrize("kind", MODULE_KINDS)
def test_a_lost_module_that_goes_on_moves_nothing_and_may_be_lost_again(
    machine: Machine, starts: MotionStarts, kind: str, lose: Lose, loss: str
) -> None:
    starts.give("pick it up", 1.0)
    for times in (1, 2):
        lose(machine, kind)
        machine.pass_time(starts, SILENCE_S + 0.5, kind)
        machine.slots[kind][0] = Slot(machine[kind])
        machine[kind].frozen = machine[kind].hangs = False
        machine.pass_time(starts, 0.5)
        assert (machine["inference"].instruction, starts.instruction) == ("", "")
        assert starts.stops == times, "once each time"


@pytest.mark.parametrize("late_s", [0.6, SILENCE_S + 1.0])
def test_a_late_report_is_no_loss(machine: Machine, starts: MotionStarts, late_s: float) -> None:
    """A busy machine delays reports, which come every 0.2 s."""
    machine.pass_time(starts, late_s, *MODULE_KINDS)
    assert starts.stops == 0


@pytest.mark.parametrize("kind", ["robot", "control"])
def test_motion_is_not_permitted_while_the_arm_s_module_is_frozen(
    machine: Machine, starts: MotionStarts, kind: str
) -> None:
    assert not starts.are_needed()
    freeze(machine, kind)
    starts.look(False)
    assert starts.are_needed(), "no message takes the quick way"
    with pytest.raises(NotReadyError, match=f"{kind} is frozen"):
        starts.permit()
    machine[kind].frozen = machine[kind].hangs = False
    starts.permit()
    assert not starts.are_needed()


def test_whoever_settles_meets_no_thread_that_has_not_begun(
    machine: Machine, starts: MotionStarts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A call requests motion at the moment when the watching thread detects a stop."""
    begins, start = threading.Event(), threading.Thread.start

    def slow_start(thread: threading.Thread) -> None:
        if thread.name == "take-back":
            begins.set()
            time.sleep(0.2)
        start(thread)

    watching = threading.Thread(target=starts.look)
    watching.start()
    watching.join()
    monkeypatch.setattr(threading.Thread, "start", slow_start)
    machine["control"].stop("the server gave no sign of life")
    watching = threading.Thread(target=starts.look)
    watching.start()
    assert begins.wait(5.0)
    starts.settle()
    watching.join()


def test_robot_and_control_that_come_back_keep_still(
    machine: Machine, starts: MotionStarts
) -> None:
    machine.slots["control"][0].phase = "exited"
    starts.look(False)
    assert machine.needs_start == starts.reason
    machine.slots["control"] = [Slot(Process("control", 99, needs_start=machine.needs_start))]
    starts.arm_started()
    assert machine["control"].needs_start, "a start of a module is no start of motion"
    starts.permit()
    assert (machine["control"].needs_start, machine.needs_start) == ("", "")


def test_a_request_from_before_a_stop_does_not_end_it(
    machine: Machine, starts: MotionStarts
) -> None:
    asked = starts.arm_stops
    machine["control"].stop("a fault")  # nobody has looked yet
    with pytest.raises(StateError, match="a fault"):
        starts.permit(asked)
    assert machine["control"].needs_start == "a fault"
    starts.permit(starts.arm_stops)
    assert machine["control"].needs_start == ""


def test_a_stop_of_the_policy_alone_voids_no_request_of_the_arm(
    machine: Machine, starts: MotionStarts
) -> None:
    asked = starts.arm_stops
    starts.note_stop("perception has ended by itself", holds_arm=False)
    assert starts.permit(asked) == starts.stops


def test_a_stop_while_motion_is_permitted_is_kept(machine: Machine, starts: MotionStarts) -> None:
    machine["control"].stop("a fault")
    set_ = machine["control"].set

    def set_then_stop(values: dict[str, Any], timeout_s: float, check: object = None) -> str:
        answer = set_(values, timeout_s, check)
        starts.note_stop("robot has ended by itself")  # as the watching thread does
        return answer

    machine["control"].set = set_then_stop  # type: ignore[method-assign]
    with pytest.raises(StateError, match="robot has ended by itself"):
        starts.permit()
    assert machine.needs_start == "robot has ended by itself"


def test_the_loss_of_a_camera_ends_no_motion_of_agents(
    machine: Machine, starts: MotionStarts
) -> None:
    machine.slots["perception"][0].phase = "exited"
    starts.look(False)
    assert (starts.stops, starts.arm_stops, machine.needs_start) == (1, 0, "")


def test_a_fault_of_the_robot_is_a_stop(machine: Machine, starts: MotionStarts) -> None:
    stops = starts.permit()
    starts.give("pick it up", 1.0)
    machine["robot"].stop("a fault of the robot: reflex")
    starts.look(False)
    starts.settle()
    assert machine["inference"].instruction == ""
    with pytest.raises(StateError, match="reflex"):
        starts.check(stops)


def test_a_stop_that_nobody_has_seen_yet_is_not_ended_by_a_request_from_before(
    machine: Machine, starts: MotionStarts
) -> None:
    machine["robot"].stop("a fault of the robot: reflex")
    starts.look(False)
    machine["robot"].stop("a fault of the robot: collision")
    machine["robot"].told.clear()
    starts._seen[machine["robot"].pid] = 1
    with pytest.raises(RefusedError, match="meanwhile: a fault of the robot: collision"):
        starts._arm()
    assert machine["robot"].told == []


def test_the_emergency_stop_ends_what_was_asked_for_once(
    machine: Machine, starts: MotionStarts
) -> None:
    starts.give("pick it up", 1.0)
    for is_latched in (True, True, False):
        starts.look(is_latched)
    assert (starts.stops, starts.instruction) == (1, "")


def test_an_instruction_is_taken_back_from_everybody_who_holds_it(
    machine: Machine, starts: MotionStarts
) -> None:
    successor = Process("inference", 77)
    machine.slots["inference"].append(Slot(successor))
    ticket, refused = starts.give("pick it up", 1.0)
    assert (refused, successor.instruction) == ("", "pick it up")
    starts.withdraw(ticket)
    assert (machine["inference"].instruction, successor.instruction) == ("", "")


def test_a_policy_that_was_loaded_meanwhile_follows_the_end(
    machine: Machine, starts: MotionStarts
) -> None:
    ticket, _ = starts.give("pick it up", 1.0)
    starts.withdraw(ticket)
    successor = Slot(Process("inference", 77, instruction="pick it up"))
    starts.follow(successor, ticket)
    assert successor.process.instruction == ""


def test_whoever_ends_takes_no_other_s_instruction(machine: Machine, starts: MotionStarts) -> None:
    mine, _ = starts.give("pick it up", 1.0)
    starts.give("put it down", 1.0)
    starts.withdraw(mine)
    assert machine["inference"].instruction == starts.instruction == "put it down"


def test_a_policy_that_does_not_give_it_back_is_ended(
    machine: Machine, starts: MotionStarts
) -> None:
    ticket, _ = starts.give("pick it up", 1.0)
    machine["inference"].hangs = True
    starts.withdraw(ticket)
    assert machine["inference"].ended


def test_a_policy_that_does_not_answer_cannot_obey_later(
    machine: Machine, starts: MotionStarts
) -> None:
    machine["inference"].hangs = True
    with pytest.raises(NotReadyError):
        starts.give("pick it up", 1.0)
    assert (starts.instruction, machine["inference"].ended) == ("", True)
