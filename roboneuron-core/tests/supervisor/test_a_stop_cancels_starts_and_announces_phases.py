"""Effect of a stop on a start in progress, and the phase of a slot.

No process is started: modules are scripted, on a test clock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest
from stop_world import Module, World

from rn_testing.fakes import fake_plan
from roboneuron.config import ModuleSettings
from roboneuron.errors import StateError
from roboneuron.supervisor.slot import Slot


def test_a_start_is_cancelled_by_a_stop_which_waits_for_its_end(world: World) -> None:
    slot = world.starting("robot")
    looks: list[float] = []

    def wait_for(look: Callable[[], bool], timeout_s: float) -> None:
        looks.append(timeout_s)
        assert not look()
        with pytest.raises(StateError, match=r"cancelled: stop_robot was called\."):
            slot.check_not_cancelled()
        slot.settle("stopped")
        assert look()

    world.supervisor.changes.wait_for = wait_for  # type: ignore[assignment, method-assign]
    assert world.supervisor.stop("robot").cancelled_start
    assert looks == [3.0 + 5.0 + 1.0]
    assert world.calls == []


def test_a_start_that_succeeds_although_it_was_cancelled_is_stopped(world: World) -> None:
    slot = world.starting("robot")

    def wait_for(look: Callable[[], bool], timeout_s: float) -> None:
        world.running("robot", slot=slot)

    world.supervisor.changes.wait_for = wait_for  # type: ignore[assignment, method-assign]
    assert not world.supervisor.stop("robot").cancelled_start
    assert slot.phase == "stopped"


def test_all_starts_are_cancelled_before_anything_is_stopped(world: World) -> None:
    world.running("robot")
    slot = world.starting("control")
    waits: list[float] = []

    def wait_for(look: Callable[[], bool], timeout_s: float) -> None:
        waits.append(timeout_s)
        assert world.calls == []
        with pytest.raises(StateError, match="everything is being stopped"):
            slot.check_not_cancelled()
        slot.settle("stopped")

    world.supervisor.changes.wait_for = wait_for  # type: ignore[assignment, method-assign]
    assert [stopped.module for stopped in world.supervisor.stop_all()] == ["robot"]
    assert waits == [9.0]


def test_a_start_without_a_choice_is_waited_for_as_long_as_a_kill_takes(world: World) -> None:
    slot = world.supervisor.slot("robot")
    waits: list[float] = []
    world.supervisor.changes.wait_for = (  # type: ignore[method-assign]
        lambda look, timeout_s: waits.append(timeout_s)  # type: ignore[assignment, misc]
    )
    world.supervisor._await_settled(slot)
    assert waits == [6.0]


def test_a_replacement_that_is_being_started_is_cancelled_too(world: World) -> None:
    world.running("control")
    beside = Slot("control", world.supervisor.changes)
    world.supervisor.slots["control"].append(beside)
    settings = ModuleSettings(
        kind="control",
        node_name="control_b",
        config=world._make_config(),
        state_directory="state",
    )
    beside.begin_start(fake_plan("control", settings.config), settings)
    world.supervisor.stop("control")
    with pytest.raises(StateError, match=r"cancelled: stop_control was called\."):
        beside.check_not_cancelled()


def test_a_cancelled_start_raises_at_its_next_look(world: World) -> None:
    slot = world.starting("robot")
    assert slot.cancel("because")
    with pytest.raises(StateError, match="The start of robot was cancelled: because"):
        slot.check_not_cancelled()


def test_a_cancelled_call_ends_its_own_start_alone(world: World) -> None:
    """A starting replacement does not end the working module."""
    world.starting("control")
    beside, halt = Slot("control", world.supervisor.changes), threading.Event()
    world.supervisor.slots["control"].append(beside)
    working = world.supervisor.slot("control")
    beside.begin_start(working.plan, working.settings, halt)  # type: ignore[arg-type]
    beside.check_not_cancelled()
    halt.set()
    working.check_not_cancelled()
    with pytest.raises(StateError, match="its call was cancelled"):
        beside.check_not_cancelled()


def test_a_call_that_is_cancelled_before_its_start_starts_nothing(world: World) -> None:
    """The cancellation comes while the plan is still being checked."""
    halt = threading.Event()
    halt.set()
    plan = fake_plan("robot", world._make_config())
    with pytest.raises(StateError, match="its call was cancelled"):
        world.supervisor.start(plan, halt=halt)
    assert world.supervisor.slot("robot").phase == "stopped"
    assert world.supervisor.slot("robot").process is None


def test_a_running_module_is_not_cancelled(world: World) -> None:
    world.running("robot")
    slot = world.supervisor.slot("robot")
    assert not slot.cancel("because")
    slot.check_not_cancelled()


def test_every_change_of_a_slot_is_announced(world: World) -> None:
    versions: list[int] = []

    def note() -> None:
        versions.append(world.supervisor.changes._version)

    note()
    slot = world.starting("robot")
    note()
    slot.cancel("because")
    note()
    slot.settle("running")
    note()
    slot.process = Module(1, world)  # type: ignore[assignment]
    slot.begin_stop()
    note()
    slot.settle("stopped")
    note()
    slot.note_exit(Module(1, world))  # type: ignore[arg-type]
    note()
    assert versions == sorted(set(versions)), "whoever waits looks again"


def test_a_claim_holds_what_is_to_be_ended(world: World) -> None:
    robot = world.running("robot")
    slot = world.supervisor.slot("robot")
    assert slot.begin_stop() is robot
    assert slot.phase == "stopping"
    slot.settle("exited")
    assert slot.process is robot, "its log and its exit are still told"


def test_an_end_that_nobody_asked_for_is_told_apart(world: World) -> None:
    robot = world.running("robot")
    robot.exit_code = -11
    robot.last_lines = lambda: ("a fault",)  # type: ignore[attr-defined]
    slot = world.supervisor.slot("robot")
    assert not slot.note_exit(Module(1, world)), "of an older process"  # type: ignore[arg-type]
    assert slot.phase == "running"
    assert slot.note_exit(robot)  # type: ignore[arg-type]
    assert slot.phase == "exited"
    assert "(pid 7) ended by itself with signal 11 at " in slot.explain_exit()
    assert "a fault" in slot.explain_exit()
    assert slot.explain_exit().endswith(str(robot.log_path))
    assert not slot.note_exit(robot), "it is told once"  # type: ignore[arg-type]


def test_an_end_during_a_stop_was_asked_for(world: World) -> None:
    robot = world.running("robot")
    slot = world.supervisor.slot("robot")
    slot.begin_stop()
    assert not slot.note_exit(robot)  # type: ignore[arg-type]
    assert (slot.phase, slot.explain_exit()) == ("stopping", "")
