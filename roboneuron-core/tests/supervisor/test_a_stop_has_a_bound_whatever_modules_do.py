"""How the supervisor stops modules: in which order, how long each may take, and what it says.

No process is started: what a module does is scripted, on a clock of the test.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from roboneuron.config import Config
from roboneuron.errors import NotReadyError, StateError
from roboneuron.modules.settings import ModuleKind, ModuleSettings
from roboneuron.supervisor import changes as changes_module
from roboneuron.supervisor import process as process_module
from roboneuron.supervisor import supervisor as supervisor_module
from roboneuron.supervisor.slot import Choice, Slot
from roboneuron.supervisor.supervisor import Supervisor

MakeConfig = Callable[..., Config]
NEVER = float("inf")


class Clock:
    """A clock that only modules make go."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def strftime(self, form: str) -> str:
        return "now"


class Module:
    """A module process and its node.

    Attributes:
        deactivates_s: how long its node takes to fall silent; NEVER for one that does not answer.
        leaves_s: how long it takes to end after SIGTERM.
    """

    def __init__(self, pid: int, world: World) -> None:
        self.pid, self.name = pid, f"module-{pid}"
        self.deactivates_s, self.leaves_s = 0.0, 0.0
        self.exit_code: int | None = None
        self.refusal: Exception | None = None
        self.is_slow_to_die = False
        self._world = world
        self._end_s = NEVER

    def announce(self, digest: bytes) -> None: ...

    def beat(self) -> None:
        self._world.calls.append(("beat", self.pid))

    def is_frozen(self) -> bool:
        return False

    def show(self) -> None: ...

    def terminate(self) -> None:
        self._world.calls.append(("terminate", self.pid))
        self._end_s = self._world.clock.now_s + self.leaves_s

    def kill(self) -> None:
        self._world.calls.append(("kill", self.pid))
        self._end_s = self._world.clock.now_s + (6.0 if self.is_slow_to_die else 0.0)
        self.exit_code = None if self.is_slow_to_die else -9

    def wait(self, timeout_s: float) -> bool:
        clock = self._world.clock
        self._world.calls.append(("wait", self.pid, round(timeout_s, 6)))
        clock.now_s = max(clock.now_s, min(self._end_s, clock.now_s + timeout_s))
        if self._end_s <= clock.now_s and self.exit_code is None:
            self.exit_code = 0
        return self._end_s <= clock.now_s


class World:
    """A supervisor whose modules are scripted."""

    def __init__(self, state: Path, make_config: MakeConfig) -> None:
        self.clock = Clock()
        self.calls: list[tuple[Any, ...]] = []
        self.changed: list[str] = []
        self.nodes: list[tuple[Any, ...]] = []
        self.closed: list[str] = []
        self._make_config = make_config
        self._pids = iter(range(7, 99))
        world = self

        class Connection:
            def __init__(self, on_status: object, log_directory: object) -> None: ...

            def link(self) -> str:
                return "link"

            def close(self) -> None:
                world.closed.append("connection")

        self.supervisor = Supervisor(
            state,
            on_change=self.changed.append,
            connect=Connection,  # type: ignore[arg-type]
        )

    def client(
        self, link: str, changes: object, node: str, announce: object, check: Callable[[], None]
    ) -> World:
        module = announce.__self__  # type: ignore[attr-defined]
        self.nodes.append((link, changes, node, module.pid, check))
        return self

    def transition(self, name: str, timeout_s: float) -> bool | None:
        pid = self.nodes[-1][3]
        module = next(m for m in self.modules() if m.pid == pid)
        self.calls.append((name, pid, round(timeout_s, 6)))
        self.nodes[-1][4]()
        if module.refusal is not None:
            raise module.refusal
        self.clock.now_s += min(module.deactivates_s, timeout_s)
        return True if module.deactivates_s <= timeout_s else None

    def modules(self) -> list[Module]:
        slots = (slot for slots in self.supervisor.slots.values() for slot in slots)
        return [slot.process for slot in slots if slot.process is not None]  # type: ignore[misc]

    def running(
        self, kind: ModuleKind, *, stop_timeout_s: float = 3.0, slot: Slot | None = None
    ) -> Module:
        """A module that was started."""
        slot = slot or self.starting(kind, stop_timeout_s=stop_timeout_s)
        module = Module(next(self._pids), self)
        slot.process = module  # type: ignore[assignment]
        assert slot.choice is not None
        self.supervisor.board.watch(slot.choice.settings.status_name, module.pid)
        slot.settle("running")
        return module

    def starting(self, kind: ModuleKind, *, stop_timeout_s: float = 3.0) -> Slot:
        slot = self.supervisor.slot(kind)
        settings = ModuleSettings(
            kind=kind,
            node_name=kind,
            config=self._make_config(stop_timeout_s=stop_timeout_s),
            state_directory="state",
        )
        slot.begin_start(Choice(settings=settings), next(self.supervisor._order))
        return slot

    def named(self, name: str) -> list[tuple[Any, ...]]:
        return [call for call in self.calls if call[0] == name]


@pytest.fixture
def world(
    tmp_path: Path, make_config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> Iterator[World]:
    world = World(tmp_path, make_config)
    for module in (changes_module, process_module, supervisor_module):
        monkeypatch.setattr(module, "time", world.clock)
    monkeypatch.setattr(supervisor_module, "NodeClient", world.client)
    yield world
    world.supervisor.spawner.shutdown()


def test_a_module_is_silenced_before_it_is_ended(world: World) -> None:
    robot = world.running("robot")
    robot.deactivates_s, robot.leaves_s = 0.5, 0.25
    stopped = world.supervisor.stop("robot")
    assert stopped is not None
    assert [call[0] for call in world.calls] == ["deactivate", "terminate", "wait", "wait"]
    assert (stopped.kind, stopped.pid, stopped.exit_code) == ("robot", robot.pid, 0)
    assert (stopped.killed, stopped.report) == (False, None)
    assert stopped.took_s == 0.75
    assert world.changed == ["robot"]
    slot = world.supervisor.slot("robot")
    assert (slot.phase, slot.process, slot.choice) == ("stopped", None, None)


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
    assert stopped is not None
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
    assert world.supervisor.stop("robot") is not None
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
    assert stopped is not None
    assert stopped.took_s == 0.0
    assert "ended with exit code 13 while being deactivated" in caplog.text


def test_a_process_that_does_not_leave_is_killed_within_its_time_to_stop(world: World) -> None:
    world.running("robot", stop_timeout_s=4.0).leaves_s = NEVER
    stopped = world.supervisor.stop("robot")
    assert stopped is not None
    assert (stopped.killed, stopped.exit_code, stopped.took_s) == (True, -9, 4.0)


def test_a_process_whose_end_nobody_knows_counts_as_killed(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.running("robot")
    monkeypatch.setattr(supervisor_module, "end_processes", lambda processes, timeout_s: set())
    stopped = world.supervisor.stop("robot")
    assert stopped is not None
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
    robot = world.running("robot")
    board, name = world.supervisor.board, f"{world._make_config().namespace}/robot"
    report = object()
    board._reports[name, str(robot.pid)] = report  # type: ignore[assignment]
    stopped = world.supervisor.stop("robot")
    assert stopped is not None
    assert stopped.report is report
    assert board.newest(name, robot.pid) is None
    assert (name, str(robot.pid)) not in board._reports


def test_all_are_silenced_in_the_reverse_order_of_starting_and_then_ended_together(
    world: World,
) -> None:
    kinds: tuple[ModuleKind, ...] = ("robot", "control", "inference", "perception")
    for kind in kinds:
        world.running(kind).leaves_s = 1.0
    stopped = world.supervisor.stop_all()
    order = [module.pid for module in stopped]
    assert [module.kind for module in stopped] == list(reversed(kinds))
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
    """A module leaves by itself within its share, and releases what it has."""
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
    assert world.supervisor.stop("robot") is None
    assert looks == [3.0 + 5.0 + 1.0]
    assert world.calls == []


def test_a_start_that_succeeds_although_it_was_cancelled_is_stopped(world: World) -> None:
    slot = world.starting("robot")

    def wait_for(look: Callable[[], bool], timeout_s: float) -> None:
        world.running("robot", slot=slot)

    world.supervisor.changes.wait_for = wait_for  # type: ignore[assignment, method-assign]
    stopped = world.supervisor.stop("robot")
    assert stopped is not None
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
    assert [stopped.kind for stopped in world.supervisor.stop_all()] == ["robot"]
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
    beside.begin_start(Choice(settings=settings), 9)
    world.supervisor.stop("control")
    with pytest.raises(StateError, match=r"cancelled: stop_control was called\."):
        beside.check_not_cancelled()


def test_a_cancelled_start_is_not_waited_for(world: World) -> None:
    assert not world.supervisor.cancel("robot", "because")
    slot = world.starting("robot")
    assert world.supervisor.cancel("robot", "because")
    with pytest.raises(StateError, match="The start of robot was cancelled: because"):
        slot.check_not_cancelled()


def test_the_newest_start_alone_is_cancelled(world: World) -> None:
    """A replacement that is being started does not end the one that works."""
    world.starting("control")
    beside = Slot("control", world.supervisor.changes)
    world.supervisor.slots["control"].append(beside)
    assert world.supervisor.slot("control").choice is not None
    beside.begin_start(world.supervisor.slot("control").choice, 2)  # type: ignore[arg-type]
    assert world.supervisor.cancel("control", "because")
    world.supervisor.slot("control").check_not_cancelled()
    with pytest.raises(StateError, match="because"):
        beside.check_not_cancelled()


def test_a_running_module_is_not_cancelled(world: World) -> None:
    world.running("robot")
    slot = world.supervisor.slot("robot")
    assert not slot.cancel("because")
    slot.check_not_cancelled()


def test_closing_stops_everything_within_the_time_of_a_leaving_server(world: World) -> None:
    world.running("robot", stop_timeout_s=30.0).leaves_s = NEVER
    supervisor = world.supervisor
    supervisor.heartbeat.start()
    supervisor.close()
    supervisor.close()
    assert world.clock.now_s == 101.5
    assert world.named("kill") == [("kill", 7)]
    assert world.closed == ["connection", "connection"]
    assert not [t for t in threading.enumerate() if t.name == "heartbeat"]
    with pytest.raises(RuntimeError, match="shutdown"):
        supervisor.spawner.submit(print)
    with pytest.raises(StateError, match="The server is shutting down"):
        supervisor.start("robot", world._make_config())


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


# Which phase a slot is in


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
    settings = slot.choice.settings if slot.choice is not None else None
    assert tuple(slot.begin_stop()) == (slot, robot, settings)
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
    assert slot.exit is not None
    assert (slot.exit.pid, slot.exit.code, slot.exit.last_lines) == (7, -11, ("a fault",))
    assert slot.exit.at.tzinfo is not None
    assert not slot.note_exit(robot), "it is told once"  # type: ignore[arg-type]


def test_an_end_during_a_stop_was_asked_for(world: World) -> None:
    robot = world.running("robot")
    slot = world.supervisor.slot("robot")
    slot.begin_stop()
    assert not slot.note_exit(robot)  # type: ignore[arg-type]
    assert (slot.phase, slot.exit) == ("stopping", None)


def test_an_end_whose_code_is_not_known_yet_counts_as_zero(world: World) -> None:
    robot = world.running("robot")
    robot.last_lines = lambda: ()  # type: ignore[attr-defined]
    slot = world.supervisor.slot("robot")
    assert slot.note_exit(robot)  # type: ignore[arg-type]
    assert slot.exit is not None
    assert slot.exit.code == 0
