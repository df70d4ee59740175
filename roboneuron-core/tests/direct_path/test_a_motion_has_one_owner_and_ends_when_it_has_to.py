"""Who moves a robot, and what ends a motion: looked at step by step, on a clock of the test's."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from arbiter_cell import Cell

from roboneuron.contract import Endpoint
from roboneuron.direct_path import arbiter as arbiter_module
from roboneuron.direct_path.arbiter import ActiveMotion, MotionArbiter
from roboneuron.direct_path.exposed import LEAD_LABEL
from roboneuron.direct_path.gate import Gate
from roboneuron.errors import NotReadyError, RefusedError, StateError
from roboneuron.feature import ExposedEndpoint
from roboneuron.gate import AuditLog


@pytest.fixture
def cell(make_gate: Callable[..., Gate], clock: Any, monkeypatch: pytest.MonkeyPatch) -> Cell:
    monkeypatch.setattr(arbiter_module, "time", clock)
    return Cell(make_gate(), clock)


@pytest.fixture
def place(endpoints: dict[str, Endpoint]) -> Callable[..., ExposedEndpoint]:
    """An endpoint of a robot, as it is exposed."""

    def make(
        robot: str = "arm", *, name: str = "velocity", label: str = "", **changes: Any
    ) -> ExposedEndpoint:
        endpoint = endpoints[name]
        return ExposedEndpoint(
            robot=robot,
            namespace=robot,
            label=label or endpoint.name,
            endpoint=endpoint,
            **changes,
        )

    return make


Place = Callable[..., ExposedEndpoint]


# Owning a robot


def test_two_robots_move_at_a_time_and_one_robot_once(cell: Cell, place: Place) -> None:
    with cell.claim(place("arm"), "drive"), cell.claim(place("base")):
        with pytest.raises(RefusedError, match=r"^drive moves 'arm' now") as caught:
            cell.claim(place("arm", name="pose")).__enter__()
        assert "stop_motion" in caught.value.hint
        cell.arbiter.check_free(place("another"))
    cell.arbiter.check_free(place("arm"))


def test_what_moves_nothing_is_free_and_used_by_one_at_a_time(cell: Cell, place: Place) -> None:
    look, other = place(name="scan", moves=False), place(name="pose", moves=False)
    with cell.claim(look, "look"):
        assert not cell.arbiter.claims.is_moving
        cell.arbiter.check_free(look)
        cell.arbiter.check_free(place())
        with pytest.raises(RefusedError, match=r"^look uses /arm/scan now"):
            cell.claim(look).__enter__()
        with cell.claim(other), cell.claim(place()):
            assert cell.arbiter.claims.is_moving
            cell.arbiter.check_free(look)
    assert not cell.arbiter.claims.is_moving
    assert cell.starts.looks == 1, "only what moves asks what has stopped the robot"


@pytest.mark.parametrize("is_ours", [True, False])
def test_only_the_topic_of_a_lead_counts_as_a_lead(cell: Cell, place: Place, is_ours: bool) -> None:
    """A robot may have an endpoint of that name."""
    lead = place(label=LEAD_LABEL, control_input="lead" if is_ours else "")
    with cell.claim(lead, "lead_arm"):
        refused = nullcontext() if is_ours else pytest.raises(RefusedError, match="lead_arm moves")
        with refused, cell.arbiter.claims.admit("pick"):
            pass
        told = [reason.rule for reason in cell.arbiter.claims.still_reasons()]
        assert told == ([] if is_ours else ["ownership"]), "teleoperation says who leads"
    cell.policies["arm"] = "The policy 'instant' moves 'arm'."
    refused = nullcontext() if is_ours else pytest.raises(RefusedError, match="instant")
    with refused:
        cell.arbiter.check_free(lead)


def test_a_robot_is_free_again_after_a_motion_that_failed(cell: Cell, place: Place) -> None:
    with pytest.raises(ZeroDivisionError), cell.claim(place()):
        raise ZeroDivisionError
    with cell.claim(place()):
        pass


def test_a_policy_keeps_motions_off_its_robot_only(cell: Cell, place: Place) -> None:
    cell.policies["arm"] = "The policy 'instant' moves 'arm'."
    with pytest.raises(RefusedError, match="instant") as caught:
        cell.claim(place("arm")).__enter__()
    assert "stop_motion" in caught.value.hint
    with cell.claim(place("base")), cell.claim(place("arm", moves=False)) as motion:
        motion.check()


def test_a_latched_stop_is_told_before_a_policy(cell: Cell, place: Place) -> None:
    cell.policies["arm"] = "The policy 'instant' moves 'arm'."
    cell.gate.latch.press(who="a person", reason="a test")
    with pytest.raises(RefusedError, match=r"a person.*Nothing was sent"):
        cell.arbiter.check_free(place())
    cell.policies.clear()
    cell.arbiter.check_free(place())  # the gate itself refuses it


# What ends a motion


def test_a_policy_that_starts_ends_the_motion_of_its_robot(cell: Cell, place: Place) -> None:
    with cell.claim(place()) as motion:
        motion.check()
        cell.policies["base"] = "Another robot."
        motion.check()
        cell.policies["arm"] = "The policy 'late' moves 'arm'."
        with pytest.raises(StateError, match="late"):
            motion.check()


def test_a_stop_of_the_robot_ends_its_motion_and_says_why(cell: Cell, place: Place) -> None:
    cell.starts.reason = "an old one"
    with cell.claim(place()) as motion, cell.claim(place(name="scan", moves=False)) as look:
        motion.check()
        cell.starts.arm_stops, cell.starts.reason = 4, "a bumper was hit"
        with pytest.raises(
            StateError, match=r"^It was stopped: a bumper was hit\. The motion is not resumed\."
        ):
            motion.check()
        look.check()


def test_a_process_that_was_frozen_does_not_go_on_with_a_motion(cell: Cell, place: Place) -> None:
    with cell.claim(place()) as motion:
        for _ in range(3):
            cell.clock.now_s += 2.0
            motion.check()
        cell.clock.now_s += 2.001
        with pytest.raises(StateError, match=r"frozen for 2\.0 s; the motion is not resumed"):
            motion.check()
        motion.check()  # whoever catches that would have to ask for a new motion


def test_a_motion_that_is_cancelled_says_so_or_why_it_was_ended(cell: Cell, place: Place) -> None:
    with cell.claim(place()) as motion:
        motion.halt.set()
        with pytest.raises(StateError, match=r"^The call was cancelled"):
            motion.check()
        motion.end("The lease has lapsed.")
        with pytest.raises(StateError, match=r"^The lease has lapsed"):
            motion.check()


def test_a_stop_that_is_pressed_during_the_look_is_told_before_the_cancelled_call(
    cell: Cell, place: Place
) -> None:
    """Pressing wakes the motion by the same event as cancelling it."""
    with cell.claim(place()) as motion:
        is_set = cell.halt.is_set

        def press() -> bool:
            cell.gate.latch.press(who="a person", reason="a test")
            return is_set()

        cell.halt.is_set = press  # type: ignore[method-assign]
        with pytest.raises(RefusedError, match="a person"):
            motion.check()


def test_an_audit_that_fails_ends_a_motion(
    cell: Cell, place: Place, make_gate: Any, ask: Any, tmp_path: Path, clock: Any
) -> None:
    (tmp_path / "full").symlink_to("/dev/full")
    gate = make_gate(audit=AuditLog(tmp_path / "full", clock.wall_ns))
    motion = ActiveMotion(gate, place(), "a test", cell.halt)
    motion.check()
    with pytest.raises(RefusedError):
        gate.check(ask(place().endpoint, {"linear": {"x": 0.1}}))
    with pytest.raises(RefusedError, match="Nothing moves without it"):
        motion.check()


def test_a_motion_without_a_say_of_stops_ends_for_none(cell: Cell, place: Place) -> None:
    motion = ActiveMotion(cell.gate, place(), "a test", cell.halt)
    motion.check()
    assert (motion.exposed.label, motion.what) == ("velocity", "a test")
    assert motion.stop_now() is None


@pytest.mark.parametrize(("limit_s", "ends"), [(0.5, True), (2.0, False)])
def test_a_motion_ends_with_a_freeze_of_the_configured_length(
    cell: Cell, place: Place, limit_s: float, ends: bool
) -> None:
    arbiter = MotionArbiter(cell.gate, cell.starts, lambda exposed: False, 0.0, limit_s)
    with arbiter.claim(place(), "a test", cell.halt) as motion:
        cell.clock.now_s += 1.0
        refused = pytest.raises(StateError, match=r"frozen for 1\.0 s")
        with refused if ends else nullcontext():
            motion.check()


# Waiting


def test_a_motion_waits_in_small_steps_until_its_time(cell: Cell, place: Place) -> None:
    with cell.claim(place()) as motion:
        motion.sleep_until(cell.clock.now_s + 0.025)
        assert cell.halt.waits_s == [0.01, 0.01, 0.005]
        motion.sleep_until(cell.clock.now_s)
        motion.sleep_until(cell.clock.now_s - 1.0)
        assert len(cell.halt.waits_s) == 3


def test_a_motion_that_has_to_end_waits_no_longer(cell: Cell, place: Place) -> None:
    def cancel() -> None:
        if len(cell.halt.waits_s) == 2:
            cell.halt.set()

    with cell.claim(place()) as motion:
        cell.halt.on_wait = cancel
        with pytest.raises(StateError, match="cancelled"):
            motion.sleep_until(cell.clock.now_s + 5.0)
        assert cell.halt.waits_s == [0.01, 0.01]
        with pytest.raises(StateError, match="cancelled"):
            motion.sleep_until(cell.clock.now_s - 1.0)


# The hold of control


def test_a_motion_begins_once_control_holds(cell: Cell, place: Place) -> None:
    cell.followed = [True, True, True, False]
    with cell.claim(place()):
        assert cell.halt.waits_s == [0.01, 0.01, 0.01]
    assert cell.asked == ["velocity"] * 4


def test_control_that_does_not_hold_in_time_keeps_a_motion_from_beginning(
    cell: Cell, place: Place
) -> None:
    cell.followed = [True]
    with pytest.raises(NotReadyError, match="nothing was sent") as caught:
        cell.claim(place()).__enter__()
    assert "stop_motion" in caught.value.hint
    assert sum(cell.halt.waits_s) == pytest.approx(0.05, abs=0.011)
    assert sum(cell.halt.waits_s) >= 0.05 - 1e-9
    cell.arbiter.check_free(place())


def test_control_may_take_all_of_its_time_to_hold(cell: Cell, place: Place) -> None:
    arbiter = MotionArbiter(cell.gate, cell.starts, cell.is_followed, 0.0)
    cell.followed = [True, False]
    with arbiter.claim(place(), "a test", cell.halt):
        assert cell.halt.waits_s == [0.01]


def test_control_has_two_seconds_to_hold_when_nobody_gives_a_bound(
    cell: Cell, place: Place
) -> None:
    arbiter = MotionArbiter(cell.gate, cell.starts, lambda exposed: True)
    with pytest.raises(NotReadyError, match="nothing was sent"):
        arbiter.claim(place(), "a test", cell.halt).__enter__()
    assert sum(cell.halt.waits_s) == pytest.approx(2.0, abs=0.011)


def test_a_stop_ends_the_wait_for_the_hold(cell: Cell, place: Place) -> None:
    cell.followed = [True]
    cell.halt.on_wait = lambda: cell.gate.latch.press(who="a person", reason="a test")
    with pytest.raises(RefusedError, match="a person"):
        cell.claim(place()).__enter__()
    assert cell.halt.waits_s == [0.01]


def test_actions_and_what_moves_nothing_do_not_wait_for_a_hold(cell: Cell, place: Place) -> None:
    cell.followed = [True]
    with (
        cell.claim(place(control_input="action")),
        cell.claim(place(name="scan", moves=False)),
    ):
        assert cell.asked == []


def test_an_arbiter_that_knows_of_no_control_waits_for_none(cell: Cell, place: Place) -> None:
    arbiter = MotionArbiter(cell.gate, cell.starts)
    with arbiter.claim(place(), "a test", cell.halt):
        assert cell.halt.waits_s == []


# Ending motions of others


def moving(cell: Cell, exposed: ExposedEndpoint, *, is_deaf: bool = False) -> tuple[Any, list[str]]:
    """A thread that moves until it is told to end, and what it was told."""
    began, told, may_leave = threading.Event(), list[str](), threading.Event()

    def play() -> None:
        halt = threading.Event()
        with cell.arbiter.claim(exposed, "a test", halt) as motion:
            began.set()
            assert halt.wait(30.0)
            try:
                motion.check()
            except StateError as error:
                told.append(error.message)
            if is_deaf:
                assert may_leave.wait(30.0)

    thread = threading.Thread(target=play)
    thread.start()
    assert began.wait(30.0)
    thread.may_leave = may_leave  # type: ignore[attr-defined]
    return thread, told


def test_every_motion_is_ended_for_a_reason(cell: Cell, place: Place) -> None:
    (arm, arm_told), (base, base_told) = moving(cell, place("arm")), moving(cell, place("base"))
    assert cell.arbiter.end_all("The lease has lapsed.", 30.0)
    assert not cell.arbiter.claims.is_moving
    for thread in (arm, base):
        thread.join(30.0)
    assert (arm_told, base_told) == (["The lease has lapsed."], ["The lease has lapsed."])
    assert cell.arbiter.end_all("Nothing moves.", 0.0)


def test_only_the_motions_that_are_meant_are_ended_and_waited_for(cell: Cell, place: Place) -> None:
    (arm, arm_told), (base, base_told) = moving(cell, place("arm")), moving(cell, place("base"))
    assert cell.arbiter.end_all("First.", 30.0, lambda exposed: exposed.robot == "arm")
    assert cell.arbiter.claims.is_moving
    assert cell.arbiter.end_all("Second.", 30.0)
    for thread in (arm, base):
        thread.join(30.0)
    assert (arm_told, base_told) == (["First."], ["Second."])


def test_a_motion_that_does_not_end_in_time_is_told(cell: Cell, place: Place) -> None:
    thread, _ = moving(cell, place(), is_deaf=True)
    assert not cell.arbiter.end_all("First.", 0.05)
    thread.may_leave.set()
    assert cell.arbiter.end_all("Second.", 30.0)
    thread.join(30.0)


def test_a_stop_waits_for_nobody_who_begins_or_ends_a_motion(cell: Cell, place: Place) -> None:
    """The list of motions is read in one step, without the lock."""
    sent: list[str] = []
    with cell.claim(place()) as motion:
        motion.stop_now = lambda: sent.append("stopped")
        with cell.arbiter.claims.admit(""):
            cell.gate.latch.press(who="a person", reason="a test")
        assert sent == ["stopped"]
        assert cell.halt.is_set()


def test_a_watch_ends_the_motion_that_it_was_set_for(cell: Cell, place: Place) -> None:
    def find_fault() -> None:
        raise RefusedError("It is where it may not be.")

    with cell.claim(place("arm")) as arm, cell.claim(place("base")) as base:
        arm.watch = find_fault
        base.check()
        with pytest.raises(RefusedError, match="where it may not be"):
            arm.check()
