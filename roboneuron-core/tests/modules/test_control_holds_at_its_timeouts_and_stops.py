"""When control holds the arm: after a stop, a refusal, a pause or a silence; on a test clock."""

from __future__ import annotations

import time

import numpy as np
import pytest
from control_cell import (
    ARM,
    SERVER_TIMEOUT_S,
    SILENT,
    START,
    STATE_TIMEOUT_S,
    STOPS,
    TIMEOUT_S,
    Cell,
    MakeHost,
    duration_s,
)

from roboneuron.contract import (
    Action,
    Hold,
    JointCommand,
    JointSample,
)


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


@pytest.mark.parametrize("word", STOPS)
def test_nothing_is_commanded_after_a_stop(cell: Cell, word: str) -> None:
    STOPS[word](cell)
    cell.act()
    assert (cell.commands, cell.asked, cell.drops()) == ([], [], {word: 1})


def test_bounds_that_are_reached_and_not_passed_stop_nothing(cell: Cell) -> None:
    cell.host.silence_s = SERVER_TIMEOUT_S
    cell.go(STATE_TIMEOUT_S, measured=False)
    cell.act()
    assert len(cell.commands) == 1


@pytest.mark.parametrize("word", [*STOPS, "stale_action"])
def test_a_stop_while_the_controller_computes_is_the_last_word(cell: Cell, word: str) -> None:
    cell.act()
    before = cell.commands
    cell.go(0.1)

    def compute(action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        if word == "stale_action":
            cell.clock.go(0.22)
        else:
            STOPS[word](cell)
        return JointCommand(names=ARM, position=START + 0.01, duration_s=0.1)

    cell.control.controller.compute = compute  # type: ignore[method-assign]
    cell.act(age_s=0.09 if word == "stale_action" else 0.0)
    assert cell.code == word
    assert cell.drops() == {word: 1}
    expected = [] if word == "stale_joint_state" else [pytest.approx([0.5, -0.5])]
    assert cell.commands == [*before, *expected], "the arm is held where it is measured"
    if word == "stale_action":
        assert cell.host.values()["note"].startswith(
            "holding: A command was ready only 0.22 s after its action"
        )


def test_a_command_that_came_too_late_is_no_setpoint(cell: Cell) -> None:
    cell.takes_s = 0.26
    cell.act(0.01)
    cell.takes_s = 0.0
    assert cell.control._limiter._sent is None, "its joints are not known any more"


def test_a_controller_that_takes_its_time_is_in_time(cell: Cell) -> None:
    cell.takes_s = 0.1
    cell.act(age_s=0.19)
    assert len(cell.commands) == 1
    assert cell.drops() == {}


def test_a_hold_of_the_controller_holds_the_arm(cell: Cell) -> None:
    cell.act()
    cell.position = np.array([0.505, -0.5])
    cell.go(0.05)
    cell.act(0.5)
    assert cell.commands[1:] == [pytest.approx([0.505, -0.5])]
    assert cell.code == "too_far"
    assert cell.drops() == {"too_far": 1}
    assert cell.host.values()["note"] == "holding: 0.5 m is more than 0.1 m."


def test_a_refused_action_leaves_the_one_before(make_host: MakeHost) -> None:
    """It ends normally, and is then held by the watchdog."""
    cell = Cell(make_host, extra='[limits]\nvelocity_fraction = 0.5\non_velocity = "refuse"\n')
    cell.act(0.01)
    acted_s = cell.control.action_s
    cell.go(0.1)
    cell.act(0.09)
    assert len(cell.commands) == 1
    assert cell.control.action_s == acted_s
    assert cell.drops() == {"limit_velocity": 1}
    cell.go(0.13)
    cell.watch()
    assert cell.code == "no_action"


def test_a_command_of_a_posture_is_judged_by_the_limits(cell: Cell) -> None:
    cell.act(0.01)
    assert cell.host.values()["sent_share"] == "1"
    cell.answer = JointCommand(names=ARM, position=np.array([np.nan, 0.0]), duration_s=0.1)
    cell.go(0.05)
    cell.act()
    assert cell.code == "unsafe_command"


def test_it_holds_after_three_quarters_of_its_timeout(cell: Cell) -> None:
    cell.act()
    cell.position = np.array([0.507, -0.5])
    cell.go(TIMEOUT_S * 0.75 - 1e-6)
    cell.watch()
    assert len(cell.commands) == 1
    cell.go(2e-6)
    cell.host.status.changed.clear()
    cell.watch()
    assert cell.commands[1:] == [pytest.approx([0.507, -0.5])]
    assert duration_s(cell.messages[1]) == pytest.approx(0.05)
    assert list(cell.messages[1].joint_names) == list(ARM)
    assert cell.host.drops() == {"holds": 1}
    assert cell.code == "no_action"
    assert cell.host.values()["note"] == "holding: No action for 0.3 s."
    assert cell.host.status.changed.is_set()
    cell.go(1.0)
    cell.watch()
    assert len(cell.commands) == 2, "it holds once"
    assert cell.host.drops() == {"holds": 1}


def test_it_holds_after_that_share_and_not_at_its_end(make_host: MakeHost) -> None:
    """0.1875 s are exact in binary."""
    cell = Cell(make_host, replace={"action_timeout_s = 0.3": "action_timeout_s = 0.25"})
    cell.act()
    cell.go(0.1875)
    cell.watch()
    assert cell.code == ""


def test_after_a_hold_the_next_command_begins_at_rest_where_the_arm_is(cell: Cell) -> None:
    cell.act()
    cell.position = np.array([0.507, -0.5])
    cell.go(0.3)
    cell.watch()
    sent = cell.control._limiter._sent
    assert sent is not None
    assert sent.start.tolist() == [0.507, -0.5]
    assert sent.displacement.tolist() == [0.0, 0.0]
    assert sent.sent_s == cell.clock.now_s


def test_it_moves_again_after_a_hold_and_holds_again(cell: Cell) -> None:
    for count in (1, 2):
        cell.act()
        cell.go(0.3)
        cell.watch()
        assert cell.host.drops()["holds"] == count


def test_it_holds_when_joint_states_cease_as_soon_as_one_comes(cell: Cell) -> None:
    """Not at an old position, to which the arm would return."""
    cell.go(STATE_TIMEOUT_S - 0.01, measured=False)
    cell.act()
    cell.go(0.02, measured=False)
    cell.watch()
    assert cell.code == "stale_joint_state"
    assert cell.host.values()["note"] == "holding: No joint state for 0.25 s."
    assert len(cell.commands) == 1
    cell.position = np.array([0.51, -0.5])
    cell.measure()
    assert cell.commands[1:] == [pytest.approx([0.51, -0.5])]
    cell.go(0.03)
    assert len(cell.commands) == 2, "it is held once"


def test_a_hold_that_is_due_is_forgotten_by_a_newer_action(cell: Cell) -> None:
    cell.control._hold_is_due = True
    cell.act()
    cell.go(0.03)
    assert len(cell.commands) == 1


def test_it_holds_when_the_server_falls_silent(cell: Cell) -> None:
    cell.act()
    cell.host.needs_start = SILENT
    cell.control.stop("server_silent")
    assert cell.code == "server_silent"
    assert SILENT in cell.host.values()["note"]
    assert len(cell.commands) == 2


def test_nothing_is_watched_before_the_first_action(cell: Cell) -> None:
    cell.host.silence_s = 9.0
    cell.go(5.0, measured=False)
    cell.watch()
    assert cell.code == ""
    assert cell.commands == []


def test_an_inactive_control_watches_nothing(cell: Cell) -> None:
    cell.act()
    cell.control.is_active = False
    cell.go(5.0)
    cell.watch()
    assert len(cell.commands) == 1


def test_deactivating_holds_and_ends_all_commands(cell: Cell) -> None:
    cell.act()
    cell.control.deactivate()
    assert len(cell.commands) == 2
    assert cell.code == "deactivated"
    assert cell.host.values()["note"] == "holding: Control was deactivated."
    cell.go(0.03)
    cell.act()
    cell.control.deactivate()
    assert len(cell.commands) == 2
    assert len(cell.poses) == 1


def test_a_control_that_was_never_active_holds_nothing(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    cell.control.deactivate()
    cell.control.stop("emergency_stop")
    cell.control.stop("needs_new_start")
    assert cell.code == ""
    assert cell.commands == []


def test_activating_again_begins_at_a_hold(cell: Cell) -> None:
    cell.act()
    cell.control._hold_is_due = True
    cell.control.activate()
    cell.go(0.5)
    cell.watch()
    assert len(cell.commands) == 1, "nothing leads back to what was before"


def test_an_emergency_stop_holds_at_once_and_its_release_moves_nothing(cell: Cell) -> None:
    cell.act()
    cell.control.emergency_stop(False)
    assert len(cell.commands) == 1
    cell.host.needs_start = "the emergency stop"
    cell.control.stop("emergency_stop")
    assert len(cell.commands) == 2
    assert cell.code == "emergency_stop"
    assert "a stop: the emergency stop." in cell.host.values()["note"]


def test_what_was_asked_for_before_a_stop_is_forgotten(cell: Cell) -> None:
    cell.act()
    cell.host.needs_start = "the emergency stop"
    cell.control.stop("needs_new_start")
    assert len(cell.commands) == 2
    assert cell.code == "needs_new_start"
    assert (
        "Motion needs a new start after a stop: the emergency stop." in cell.host.values()["note"]
    )


def test_a_further_reason_to_hold_is_told_and_moves_nothing(cell: Cell) -> None:
    cell.act()
    cell.control.deactivate()
    cell.control.activate()
    cell.control.stop("emergency_stop")
    assert cell.code == "emergency_stop"
    assert len(cell.commands) == 2
    assert cell.host.drops() == {"holds": 1}


def test_a_hold_names_the_joints_of_the_arm_only(cell: Cell) -> None:
    cell.act()
    cell.go(0.05, measured=False)
    cell.measure(names=("finger", "b", "a"), position=np.array([0.04, -0.5, 0.51]))
    cell.control.stop("emergency_stop")
    assert cell.commands[1] == pytest.approx([0.51, -0.5])
    assert list(cell.messages[1].joint_names) == list(ARM)


def test_the_clock_of_the_test_is_the_modules_clock(cell: Cell) -> None:
    assert cell.control._pose_s == cell.clock.now_s != time.monotonic()
