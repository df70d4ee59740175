"""A module that commands an arm holds it, whatever converts actions into commands; on a test
clock.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from control_cell import ARM, START, STATE_TIMEOUT_S, TIMEOUT_S, MakeHost
from loop_plugin import Adder

from roboneuron.contract import JointCommand, JointSample
from roboneuron.gate.motion.command import Asked
from roboneuron.modules.holding import HoldingModule


class Cell:
    """A module that has just sent a command, without a feature's part of control."""

    def __init__(self, make_host: MakeHost) -> None:
        self.host = make_host("control")
        self.module = HoldingModule(self.host)
        self.module.limit_with(Adder(None, self.module.profile))
        self.module.activate()
        self.measure()
        step = JointCommand(names=ARM, position=START + 0.01, duration_s=0.1)
        self.module.act(self.host.clock.wall_ns, lambda: Asked(now=lambda *_: step))
        self.host.publishers["joint_trajectory"].messages.clear()

    def measure(self) -> None:
        stamp_ns = self.host.clock.wall_ns
        joints = JointSample(names=ARM, position=START.copy(), stamp_ns=stamp_ns)
        assert self.module.believe(joints, self.host.clock.now_s)

    def holds(self) -> list[list[float]]:
        self.host.repeated[0][1]()
        sent = self.host.publishers["joint_trajectory"].messages
        return [list(message.points[0].positions) for message in sent]


LOST: dict[str, Callable[[Any], object]] = {
    "no_action": lambda cell: cell.host.clock.go(0.8 * TIMEOUT_S),
    "server_silent": lambda cell: cell.module.stop("server_silent"),
    "emergency_stop": lambda cell: cell.module.stop("emergency_stop"),
    "needs_new_start": lambda cell: cell.module.stop("needs_new_start"),
    "deactivated": lambda cell: cell.module.deactivate(),
}


@pytest.mark.parametrize("word", LOST)
def test_the_arm_is_held_where_it_is_measured(make_host: MakeHost, word: str) -> None:
    cell = Cell(make_host)
    assert cell.holds() == []
    LOST[word](cell)
    assert cell.holds() == [list(START)]
    assert cell.host.values()["hold_code"] == word
    assert cell.module.is_holding


def test_without_a_fresh_joint_state_the_next_one_is_held(make_host: MakeHost) -> None:
    cell = Cell(make_host)
    cell.host.clock.go(STATE_TIMEOUT_S + 0.01)
    cell.module.action_s = cell.host.clock.now_s
    assert cell.holds() == []
    assert cell.host.values()["hold_code"] == "stale_joint_state"
    cell.measure()
    assert cell.holds() == [list(START)]


def test_a_robot_that_is_lost_is_named_rather_than_the_actions_refused_without_it(
    make_host: MakeHost,
) -> None:
    cell = Cell(make_host)
    cell.host.clock.go(0.8 * TIMEOUT_S)
    assert cell.holds() == [list(START)]
    assert cell.host.values()["hold_code"] == "no_action"
    cell.host.clock.go(STATE_TIMEOUT_S)
    assert cell.holds() == [list(START)]
    assert cell.host.values()["hold_code"] == "stale_joint_state"


def test_of_both_causes_the_lost_robot_is_named(make_host: MakeHost) -> None:
    cell = Cell(make_host)
    cell.host.clock.go(TIMEOUT_S + STATE_TIMEOUT_S)
    assert cell.holds() == []
    assert cell.host.values()["hold_code"] == "stale_joint_state"
