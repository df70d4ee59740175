"""In stepped time the judge looks when a turn of the policy is over, and the simulation stands."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from rn_eval_stepped.task import SteppedTaskTime
from rn_eval_stepped.world_clock import FREE, ROWS_METRIC, TURN_METRIC, TURN_PARAMETER, WorldClock
from rn_standard.tasks.live import LiveCell
from roboneuron.feature import Report
from roboneuron.supervisor.health import ModuleView

MOVING, WAITING, RESTING = 0, 1, 3
LONG = 3
"""Looks that each phase lasts."""


class SteppedHost:
    """A server, a policy and a simulation, which go on with each look at them."""

    def __init__(self) -> None:
        self.phase, self.count, self.time_s = RESTING, 0, 0.0
        self.given: list[int] = []
        self.rows, self.sends, self.exists = 0, True, True
        self._left = 0
        self.metrics: dict[str, str] = {}
        self.config = SimpleNamespace(namespace="arm")
        self.server: Any = None
        self.loop = SimpleNamespace(
            starts=SimpleNamespace(
                arm_stops=0,
                permit=lambda arm_stops: 0,
                check=lambda stops: None,
                give=lambda text, timeout_s: (1, ""),
                withdraw=lambda ticket: None,
                stops=0,
                ticket=1,
            ),
            set_parameters=self.set_parameters,
            emergency_stop=SimpleNamespace(is_latched=lambda: False, check=lambda: None),
        )
        self.modules = SimpleNamespace(
            view=self.view, require_running=self.view, views=lambda: [self.view("inference")]
        )

    def view(self, kind: str) -> Any:
        self._go_on()
        report = Report(metrics=self.metrics)
        phase = "running" if self.exists else "stopped"
        return ModuleView(kind=kind, phase=phase, report=report)

    def set_parameters(self, kind: str, values: dict[str, int], timeout_s: float) -> str:
        assert kind == "inference"
        turn = values[TURN_PARAMETER]
        self.given.append(turn)
        if turn > 0 and self.exists:
            self._left = 2 * LONG
        return ""

    def _go_on(self) -> None:
        if self._left:
            self._left -= 1
            if self._left == LONG:  # the policy has acted
                self.rows += self.sends
                self.metrics = {TURN_METRIC: str(self.given[-1]), ROWS_METRIC: str(self.rows)}
                self.phase = MOVING if self.sends else self.phase
            if self._left == 0 and self.sends:
                self.phase, self.count, self.time_s = WAITING, self.count + 1, self.time_s + 0.1

    def clock(self) -> WorldClock:
        self._go_on()
        return WorldClock(phase=self.phase, count=self.count, since_ns=0, time_s=self.time_s)

    def await_rest(self) -> None:
        self.phase = RESTING

    def task_time(self, halt: threading.Event, is_lost: Callable[[], bool]) -> SteppedTaskTime:
        world: Any = self
        return SteppedTaskTime(world, world.server, halt, is_lost)


@pytest.fixture
def host() -> SteppedHost:
    """The server, which is its own simulation."""
    return SteppedHost()


@pytest.fixture
def cell(host: SteppedHost) -> LiveCell:
    nothing: Any = {}
    server: Any = SimpleNamespace(
        config=host.config, loop=host.loop, modules=host.modules, clock=lambda namespace: host
    )
    host.server = server
    return LiveCell(
        server,
        None,
        "operator",
        lambda text: None,
        threading.Event(),
        lambda: "",
        nothing,
        (),
    )


def test_a_turn_is_over_when_its_row_was_carried_out(host: SteppedHost, cell: LiveCell) -> None:
    cell.begin("pick it up")
    assert host.given == [0]
    for number in (1, 2):
        assert cell.wait(0.05) is False
        assert host.given[-1] == number
        assert (host.phase, host.count) == (WAITING, number)
        assert cell.now_s() == pytest.approx(0.1 * number)


def test_a_turn_without_a_row_lets_time_pass(host: SteppedHost, cell: LiveCell) -> None:
    host.sends = False
    cell.begin("pick it up")
    cell.wait(0.05)
    assert (host.count, host.metrics[TURN_METRIC]) == (0, "1")
    assert cell.now_s() == pytest.approx(1.0)


def test_no_turn_is_awaited_of_a_policy_that_is_gone(host: SteppedHost, cell: LiveCell) -> None:
    cell.begin("pick it up")
    host.exists = False
    assert cell.wait(0.05) is False
    assert cell.policy().taken


def test_nothing_moves_while_the_judge_only_waits(host: SteppedHost, cell: LiveCell) -> None:
    cell.wait(0.05)
    assert host.given == []
    assert cell.now_s() == pytest.approx(0.05)


def test_the_policy_is_free_again_at_rest(host: SteppedHost, cell: LiveCell) -> None:
    cell.begin("pick it up")
    cell.wait(0.05)
    cell.end()
    assert host.phase == RESTING
    assert host.given[-1] == FREE
