"""Faults in joint states, clocks, actions and limits, judged by what control sends; on a test
clock.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_cell import START, STATE_TIMEOUT_S, TIMEOUT_S, Cell, MakeHost
from std_msgs.msg import Float64MultiArray

from roboneuron.errors import ConfigurationError

PERIOD_S = 0.03
Fault = Callable[[int, int], dict[str, Any] | None]
"""From the time now and at the fault [ns]: what a joint state has instead; None for no state."""


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


FAULTS: dict[str, Fault] = {
    "stale": lambda now_ns, _: {"stamp_ns": now_ns - 1_000_000_000},
    "future": lambda now_ns, _: {"stamp_ns": now_ns + 3_600_000_000_000},
    "frozen": lambda _, began_ns: {"stamp_ns": began_ns},
    "unstamped": lambda *_: {"stamp_ns": 1},
    "missing-joint": lambda *_: {"names": ("a",), "position": np.array([0.5])},
    "unknown-names": lambda *_: {"names": ("c", "d")},
    "doubled-names": lambda *_: {"names": ("a", "a")},
    "too-few": lambda *_: {"position": np.array([0.1])},
    "nan": lambda *_: {"position": np.array([0.5, np.nan])},
    "infinity": lambda *_: {"position": np.array([-np.inf, 0.0])},
    "silent": lambda *_: None,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_joint_states_with_a_fault_end_the_commands_until_the_arm_can_be_held_where_it_is(
    cell: Cell, fault: str
) -> None:
    """The policy goes on; only the states are faulty."""
    cell.act()
    assert cell.commands[0][0] > 0.5
    began_ns = cell.clock.wall_ns
    for _ in range(12):
        cell.go(PERIOD_S, measured=False)
        changes = FAULTS[fault](cell.clock.wall_ns, began_ns)
        if changes is not None:
            cell.measure(**changes)
        cell.act()
        cell.watch()
    assert cell.code == "stale_joint_state"
    count = len(cell.commands)
    assert count == 1 + int(STATE_TIMEOUT_S / PERIOD_S), "nothing leads back to an old posture"
    assert cell.drops()["stale_joint_state"] == 12 + 1 - count
    if fault not in ("silent", "frozen"):
        assert cell.drops()["bad_joint_state"] == 12
        assert cell.host.values()["error_code"] in ("unsafe", "invalid_input", "not_ready")
    cell.position = np.array([0.51, -0.5])
    cell.go(PERIOD_S)
    assert cell.commands[count:] == [pytest.approx([0.51, -0.5])]


STRANGE: dict[str, Fault] = {
    "nan": lambda *_: {"position": np.array([np.nan, np.nan])},
    "elsewhere": lambda *_: {"position": np.array([-0.9, 0.9])},
    "unknown-names": lambda *_: {"names": ("c", "d")},
    "missing-joint": lambda *_: {"names": ("b",), "position": np.array([-0.5])},
    "future": lambda *_: {"stamp_ns": 2**62},
    "old": lambda *_: {"stamp_ns": 1},
    "reordered": lambda now_ns, _: {
        "position": np.array([0.48, -0.5]),
        "stamp_ns": now_ns - 100_000_000,
    },
}


@pytest.mark.parametrize("fault", STRANGE)
def test_bad_joint_states_of_a_foreign_node_are_counted_and_do_not_matter(
    cell: Cell, fault: str
) -> None:
    for _ in range(20):
        cell.go(0.005)
        cell.clock.go(0.005)
        cell.measure(**(STRANGE[fault](cell.clock.wall_ns, 0) or {}))
    assert cell.drops() == {"bad_joint_state": 20}
    cell.act()
    assert cell.commands == [pytest.approx([0.51, -0.5])]


@pytest.mark.parametrize("jump_s", [-0.2, 0.2], ids=["back", "forward"])
def test_stamps_of_a_robot_whose_clock_jumps_stop_the_arm_for_one_timeout_only(
    cell: Cell, jump_s: float
) -> None:
    cell.act()
    after_s = 0.0
    while after_s <= STATE_TIMEOUT_S:
        cell.go(PERIOD_S, measured=False)
        after_s += PERIOD_S
        cell.measure(stamp_ns=cell.clock.wall_ns + int(jump_s * 1e9))
    cell.act()
    assert len(cell.commands) == 2


@pytest.mark.parametrize(
    ("jump_s", "word"),
    [
        (10.0, "stale_action"),
        (-10.0, "future_action"),
        (3e7, "stale_action"),
        (-3e7, "future_action"),
    ],
)
def test_clock_that_jumps_stops_actions_and_lets_them_through_once_it_is_right(
    cell: Cell, jump_s: float, word: str
) -> None:
    cell.act()
    cell.go(0.05)
    cell.act(age_s=jump_s)
    assert (len(cell.commands), cell.drops()) == (1, {word: 1})
    cell.go(TIMEOUT_S)
    cell.watch()
    assert cell.code == "no_action"
    assert cell.commands[1:] == [pytest.approx(START.tolist())]
    cell.act()
    assert len(cell.commands) == 3


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ([np.nan, 0, 0, 0, 0, 0, 1], "non_finite"),
        ([0, np.inf, 0, 0, 0, 0, 1], "non_finite"),
        ([0.01] * 6, "malformed"),
        ([0.01] * 8, "malformed"),
        ([], "malformed"),
        ([0.01, 0, 0, 0, 0, 0, 1.5], "malformed"),
        ([0.2, 0, 0, 0, 0, 0, 1], "too_far"),
        ([1e308, 0, 0, 0, 0, 0, 1], "too_far"),
    ],
)
def test_bad_action_is_counted_and_moves_nothing(
    cell: Cell, values: list[float], word: str
) -> None:
    cell.receive(Float64MultiArray(data=[float(value) for value in values]))
    assert (cell.commands, cell.drops()) == ([], {word: 1})


def test_limits_are_applied_counted_reported_and_audited(
    make_host: MakeHost, tmp_path: Path
) -> None:
    cell = Cell(make_host, extra="[limits]\nvelocity_fraction = 0.05\n")
    cell.act(0.09)
    moved = cell.commands[0][0] - 0.5
    assert 0.0 < moved <= 0.05 * 0.1 + 1e-9
    values = cell.host.values()
    assert values["limited.velocity"] == "1"
    assert float(values["asked_joint_speed"]) == pytest.approx(0.9, rel=1e-3)
    assert float(values["sent_joint_speed"]) == pytest.approx(0.05, rel=1e-3)
    assert "allowed is 0.05" in values["limit"]
    record = json.loads((tmp_path / "audit.jsonl").read_text().splitlines()[-1])
    assert (record["who"], record["verdict"]) == ("control", "scaled")
    assert record["arguments"]["asked"]["joint_speed"] > record["arguments"]["sent"]["joint_speed"]


def test_limit_that_holds_commands_the_measured_posture(make_host: MakeHost) -> None:
    cell = Cell(make_host, extra='[limits]\nvelocity_fraction = 0.5\non_velocity = "hold"\n')
    cell.act()
    cell.position = np.array([0.505, -0.5])
    cell.go(0.05)
    cell.act(0.09)
    assert cell.commands[1:] == [pytest.approx([0.505, -0.5])]
    assert cell.drops() == {"limit_velocity": 1}
    assert cell.code == "limit_velocity"


def test_limit_that_refuses_sends_nothing(make_host: MakeHost) -> None:
    cell = Cell(make_host, extra='[limits]\nvelocity_fraction = 0.5\non_velocity = "refuse"\n')
    cell.act(0.09)
    assert (cell.commands, cell.drops()) == ([], {"limit_velocity": 1})


def test_limits_that_do_not_fit_the_robot_refuse_to_start(make_host: MakeHost) -> None:
    zone = '[[limits.zones]]\nname = "vase"\nlower_m = [1.0, 0.0, 0.0]\nupper_m = [0.0, 1.0, 1.0]\n'
    with pytest.raises(ConfigurationError, match="'vase'"):
        Cell(make_host, extra=zone)
