"""The supervisor's stop of modules: order, time limits, and reports.

No process is started: modules are scripted, on a test clock.
"""

from __future__ import annotations

import logging
import threading

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from stop_world import NEVER, World

from rn_testing.fakes import fake_plan
from rn_testing.waiting import wait_until
from roboneuron.errors import NotReadyError, StateError
from roboneuron.modules.report import Report
from roboneuron.modules.settings import ModuleKind
from roboneuron.supervisor import supervisor as supervisor_module


def test_a_module_is_silenced_before_it_is_ended(world: World) -> None:
    robot = world.running("robot")
    robot.deactivates_s, robot.leaves_s = 0.5, 0.25
    stopped = world.supervisor.stop("robot")
    assert [call[0] for call in world.calls] == ["deactivate", "terminate", "wait", "wait"]
    assert (stopped.module, stopped.pid, stopped.exit_code) == ("robot", robot.pid, 0)
    assert (stopped.killed, stopped.report) == (False, None)
    assert stopped.took_s == 0.75
    assert world.changed == ["robot"]
    slot = world.supervisor.slot("robot")
    assert (slot.phase, slot.process, slot.plan) == ("stopped", None, None)


def test_the_node_is_asked_by_its_name_through_the_servers_link(world: World) -> None:
    robot = world.running("robot")
    world.supervisor.stop("robot")
    link, changes, node, pid, _ = world.nodes[0]
    assert (link, changes, node, pid) == (
        "link",
        world.supervisor.changes,
        f"/{world._make_config().namespace}/robot",
        robot.pid,
    )


def test_a_node_that_does_not_answer_is_waited_for_two_seconds_at_most(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    world.running("robot", stop_timeout_s=30.0).deactivates_s = NEVER
    stopped = world.supervisor.stop("robot")
    assert world.named("deactivate") == [("deactivate", 7, 2.0)]
    assert stopped.took_s == 2.0, "it is ended all the same"
    assert "robot did not answer `deactivate` within 2.0 s" in caplog.text


def test_a_node_has_half_of_its_time_to_stop_at_most(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    world.running("robot", stop_timeout_s=1.0)
    world.supervisor.stop("robot")
    assert world.named("deactivate") == [("deactivate", 7, 0.5)]
    assert caplog.text == ""


def test_a_node_that_answers_with_an_error_is_ended(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    world.running("robot").refusal = NotReadyError("The driver hangs.")
    assert not world.supervisor.stop("robot").cancelled_start
    assert "Deactivating robot: The driver hangs." in caplog.text


def test_a_process_that_died_while_it_is_deactivated_is_not_waited_for(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    robot = world.running("robot")
    robot.deactivates_s = NEVER
    robot.exit_code = 13
    robot.last_lines = lambda: ()  # type: ignore[attr-defined]
    robot.log_path = "robot.log"  # type: ignore[attr-defined]
    stopped = world.supervisor.stop("robot")
    assert stopped.took_s == 0.0
    assert "ended with exit code 13 while being deactivated" in caplog.text


def test_a_process_that_does_not_leave_is_killed_within_its_time_to_stop(world: World) -> None:
    world.running("robot", stop_timeout_s=4.0).leaves_s = NEVER
    stopped = world.supervisor.stop("robot")
    assert (stopped.killed, stopped.exit_code, stopped.took_s) == (True, -9, 4.0)


def test_a_process_whose_end_nobody_knows_counts_as_killed(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.running("robot")
    monkeypatch.setattr(supervisor_module, "end_processes", lambda processes, timeout_s: set())
    stopped = world.supervisor.stop("robot")
    assert stopped.exit_code == -9


def test_a_slot_is_being_stopped_until_its_process_is_dead(world: World) -> None:
    robot = world.running("robot", stop_timeout_s=1.0)
    robot.leaves_s, robot.is_slow_to_die = NEVER, True
    with pytest.raises(NotReadyError, match="survives SIGKILL"):
        world.supervisor.stop("robot")
    slot = world.supervisor.slot("robot")
    assert slot.phase == "stopping"
    assert slot.process is robot, "it may still move the arm"
    with pytest.raises(StateError, match="robot is not running"):
        world.supervisor.stop("robot")


def test_the_last_report_is_told_and_then_forgotten(world: World) -> None:
    world.running("robot")
    slot, report = world.supervisor.slot("robot"), Report()
    slot.report = report
    stopped = world.supervisor.stop("robot")
    assert stopped.report is report
    assert slot.report is None


def test_a_standby_is_heard_by_the_other_name_of_its_kind(world: World) -> None:
    """A module that is to replace another one has another node name than its kind."""
    module = world.running("inference")
    slot = world.supervisor.slot("inference")
    assert slot.settings is not None
    settings = slot.settings.model_copy(update={"node_name": "inference_b"})
    slot.settings = settings
    world.supervisor._ours.add(str(module.pid))
    status = DiagnosticStatus(name=settings.status_name, hardware_id=str(module.pid))
    world.supervisor.receive(DiagnosticArray(status=[status]))
    assert slot.report is not None


def test_all_are_silenced_in_the_reverse_order_of_starting_and_then_ended_together(
    world: World,
) -> None:
    kinds: tuple[ModuleKind, ...] = ("robot", "control", "inference", "perception")
    for kind in kinds:
        world.running(kind).leaves_s = 1.0
    stopped = world.supervisor.stop_all()
    order = [module.pid for module in stopped]
    assert [one.module for one in stopped] == list(reversed(kinds))
    assert world.calls[:8] == [
        *(("deactivate", pid, 1.5) for pid in order),
        *(("terminate", pid) for pid in order),
    ]
    assert stopped[-1].took_s == 1.0, "they leave side by side"


def test_the_longest_time_to_stop_holds_when_several_are_ended(world: World) -> None:
    world.running("robot", stop_timeout_s=2.0).leaves_s = NEVER
    world.running("control", stop_timeout_s=5.0).leaves_s = NEVER
    assert [stopped.took_s for stopped in world.supervisor.stop_all()] == [5.0, 5.0]


def test_within_a_bound_each_module_has_its_share_and_the_rest_is_for_leaving(
    world: World,
) -> None:
    for kind in ("robot", "control"):
        module = world.running(kind, stop_timeout_s=30.0)
        module.deactivates_s = module.leaves_s = NEVER
    stopped = world.supervisor.stop_all(1.5)
    assert [call[2] for call in world.named("deactivate")] == [0.5, 0.5]
    assert [one.killed for one in stopped] == [True, True]
    assert [one.took_s for one in stopped] == pytest.approx([1.5, 1.5])


def test_within_a_bound_silence_that_costs_nothing_leaves_more_time_to_leave(
    world: World,
) -> None:
    world.running("robot", stop_timeout_s=30.0).leaves_s = NEVER
    assert [one.took_s for one in world.supervisor.stop_all(1.5)] == [1.5]


def test_a_silence_that_took_too_long_leaves_a_share_to_leave(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A module ends by itself within its share of the time, and releases its resources."""
    robot = world.running("robot", stop_timeout_s=30.0)
    robot.leaves_s = NEVER
    transition = world.transition

    def late(name: str, timeout_s: float) -> bool | None:
        world.clock.now_s += 9.0
        return transition(name, timeout_s)

    monkeypatch.setattr(world, "transition", late)
    world.supervisor.stop_all(1.5)
    assert world.named("wait")[0] == ("wait", 7, 0.75)


def test_nothing_to_stop_is_no_error_for_all_and_one_for_one(world: World) -> None:
    assert world.supervisor.stop_all() == []
    with pytest.raises(StateError, match="robot is not running"):
        world.supervisor.stop("robot")


def test_closing_stops_everything_within_the_time_of_a_leaving_server(world: World) -> None:
    world.running("robot", stop_timeout_s=30.0).leaves_s = NEVER
    supervisor = world.supervisor
    before = set(threading.enumerate())
    supervisor.heartbeat.start()
    supervisor.close()
    supervisor.close()
    assert world.clock.now_s == 101.5
    assert world.named("kill") == [("kill", 7)]
    assert world.closed == ["connection", "connection"]
    wait_until(
        lambda: not [t for t in set(threading.enumerate()) - before if t.name == "heartbeat"]
    )
    with pytest.raises(RuntimeError, match="shutdown"):
        supervisor._spawning.submit(print)
    with pytest.raises(StateError, match="The server is shutting down"):
        supervisor.start(fake_plan("robot", world._make_config()))


def test_every_living_module_gets_a_beat(world: World) -> None:
    for kind in ("robot", "control"):
        world.running(kind)
    world.supervisor._beat()
    assert sorted(world.named("beat")) == [("beat", 7), ("beat", 8)]


def test_a_stop_is_logged_with_the_exit_code(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    world.running("robot")
    with caplog.at_level(logging.INFO):
        world.supervisor.stop("robot")
    assert "Stopped robot: pid 7, exit code 0." in caplog.text
