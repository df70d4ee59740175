"""Which action moves the arm and for how long, and control's report of the measured arm; on a test
clock.
"""

from __future__ import annotations

import numpy as np
import pytest
from control_cell import (
    ARM,
    TIMEOUT_S,
    Cell,
    MakeHost,
    duration_s,
)

from roboneuron.contract import (
    Hold,
    JointCommand,
    JointSample,
)
from roboneuron.errors import UnsafeError
from roboneuron.modules.control import module as control_module
from roboneuron.ros.messages import to_action_message


@pytest.fixture
def cell(make_host: MakeHost) -> Cell:
    return Cell(make_host)


def test_it_is_ready_once_the_arm_was_measured(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    cell.control.activate()
    values = cell.host.values()
    assert values["ready"] == "false"
    assert values["waiting_for"] == "joint states on joint_states (is the robot running?)"
    cell.measure()
    assert cell.host.values()["ready"] == "true"


def test_an_inactive_control_publishes_nothing(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)
    cell.measure()
    assert cell.poses == []
    cell.act()
    assert cell.asked == []
    assert cell.host.values()["ready"] == "false"


def test_the_pose_is_published_fifty_times_a_second(cell: Cell) -> None:
    assert len(cell.poses) == 1
    for _ in range(3):
        cell.go(0.009)
    assert len(cell.poses) == 2, "after 27 ms"


def test_a_pose_is_due_exactly_one_period_after_the_one_before(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_module, "_POSE_PERIOD_S", 0.03125)
    cell.go(0.03125)
    assert len(cell.poses) == 2


def test_a_pose_is_in_the_base_frame_and_noted_as_sent(cell: Cell) -> None:
    assert cell.poses[0].header.frame_id == "base"
    assert cell.host.handover.sent == ["pose"]


def test_a_repeated_state_is_passed_over(cell: Cell) -> None:
    stamp_ns = cell.clock.wall_ns
    cell.clock.go(0.03)
    cell.measure(stamp_ns=stamp_ns)
    assert len(cell.poses) == 1


def test_a_bad_state_is_counted_and_told_until_a_good_one_comes(cell: Cell) -> None:
    cell.go(0.03, measured=False)
    cell.measure(position=np.array([np.nan, 0.0]))
    assert cell.drops() == {"bad_joint_state": 1}
    assert "non-finite" in cell.host.values()["error"]
    cell.go(0.03)
    assert "non-finite" not in cell.host.values().get("error", "")
    assert cell.drops() == {"bad_joint_state": 1}


def test_a_controller_that_knows_no_pose_is_told_and_not_ready(make_host: MakeHost) -> None:
    cell = Cell(make_host, activate=False)

    def forward(joints: JointSample) -> None:
        raise UnsafeError("outside of the joints' travel")

    cell.control.controller.forward = forward  # type: ignore[method-assign, assignment]
    cell.control.activate()
    cell.measure()
    assert cell.host.values()["ready"] == "false"
    assert cell.poses == []
    assert cell.drops() == {"bad_joint_state": 1}


# Actions


def test_an_action_moves_the_arm_by_one_command(cell: Cell) -> None:
    cell.host.status.changed.clear()
    cell.act(0.01, age_s=0.05)
    assert cell.commands == [pytest.approx([0.51, -0.5])]
    action, joints, _ = cell.asked[0]
    assert action.translation_m[0] == 0.01
    assert joints.position.tolist() == [0.5, -0.5]
    values = cell.host.values()
    assert values["note"] == "following actions"
    assert cell.host.handover.sent == ["pose", "command"]
    assert cell.host.status.output.total == 1
    assert list(cell.host.status.latency) == pytest.approx([50.0])
    assert cell.host.status.changed.is_set()
    assert cell.drops() == {}


def test_what_the_controller_reports_is_told(cell: Cell) -> None:
    cell.answer = JointCommand(
        names=ARM,
        position=np.array([0.501, -0.5]),
        duration_s=0.1,
        residual_m=0.003,
        residual_rad=0.04,
    )
    cell.takes_s = 0.012
    cell.act()
    values = cell.host.values()
    assert (values["residual_m"], values["residual_rad"]) == ("0.003", "0.04")
    assert values["compute_ms"] == "12"


def test_the_first_action_has_a_tenth_of_a_second(cell: Cell) -> None:
    cell.act()
    assert cell.asked[0][2] == 0.1
    assert duration_s(cell.messages[0]) == pytest.approx(0.1)


def test_soon_after_the_machine_was_started_a_first_action_is_a_first_action(
    make_host: MakeHost,
) -> None:
    cell = Cell(make_host, activate=False)
    cell.clock.now_s = 0.5
    cell.control.activate()
    cell.measure()
    assert len(cell.poses) == 1
    cell.act()
    assert cell.asked[0][2] == 0.1


def test_a_later_action_has_the_time_since_the_one_before(cell: Cell) -> None:
    cell.act()
    cell.go(0.07)
    cell.act()
    cell.go(0.2)
    cell.act()
    assert [step_s for _, _, step_s in cell.asked[1:]] == pytest.approx([0.07, 0.2])


def test_no_action_has_less_than_the_shortest_step(cell: Cell) -> None:
    cell.act()
    cell.go(0.005)
    cell.act()
    assert cell.asked[1][2] == 0.02


def test_an_action_after_a_pause_has_the_time_of_a_first_one(cell: Cell) -> None:
    cell.act()
    cell.go(TIMEOUT_S + 1e-6)
    cell.act()
    cell.go(TIMEOUT_S - 0.001)
    cell.act()
    assert [step_s for _, _, step_s in cell.asked[1:]] == pytest.approx([0.1, TIMEOUT_S - 0.001])


def test_a_pause_of_exactly_the_timeout_is_a_pause(make_host: MakeHost) -> None:
    """0.25 s are exact in binary."""
    cell = Cell(make_host, replace={"action_timeout_s = 0.3": "action_timeout_s = 0.25"})
    cell.act()
    cell.go(0.25)
    cell.act()
    assert cell.asked[1][2] == 0.1


def test_actions_that_were_held_up_have_the_time_between_their_sendings(cell: Cell) -> None:
    """They arrive together, although they were not sent together."""
    sent_ns = cell.clock.wall_ns - 120_000_000
    cell.act(sent_ns=sent_ns)
    cell.go(0.001)
    cell.act(sent_ns=sent_ns + 60_000_000)
    cell.go(0.001)
    cell.act(sent_ns=sent_ns + 121_000_000)
    assert [step_s for _, _, step_s in cell.asked[1:]] == pytest.approx([0.06, 0.061])


def test_the_time_between_sendings_is_exact(cell: Cell) -> None:
    sent_ns = cell.clock.wall_ns - 120_000_000
    cell.act(sent_ns=sent_ns)
    cell.act(sent_ns=sent_ns + 62_500_000)
    assert cell.asked[1][2] == 0.0625


def test_the_time_between_sendings_counts_as_a_first_step_at_most(cell: Cell) -> None:
    sent_ns = cell.clock.wall_ns - 250_000_000
    cell.act(sent_ns=sent_ns)
    cell.go(0.001)
    cell.act(sent_ns=sent_ns + 240_000_000)
    assert cell.asked[1][2] == pytest.approx(0.1)


def test_an_action_may_be_as_old_as_the_timeout(cell: Cell) -> None:
    cell.act(age_s=TIMEOUT_S - 1e-6)
    assert len(cell.commands) == 1
    cell.act(age_s=TIMEOUT_S + 1e-6)
    assert (len(cell.commands), cell.drops()) == (1, {"stale_action": 1})


def test_an_action_exactly_at_the_timeout_counts(make_host: MakeHost) -> None:
    cell = Cell(make_host, replace={"action_timeout_s = 0.3": "action_timeout_s = 0.25"})
    cell.act(age_s=0.25)
    assert len(cell.commands) == 1


def test_an_action_that_is_a_nanosecond_too_old_is_stale(make_host: MakeHost) -> None:
    cell = Cell(make_host, replace={"action_timeout_s = 0.3": "action_timeout_s = 2.0"})
    cell.act(sent_ns=cell.clock.wall_ns - 2_000_000_001)
    assert cell.drops() == {"stale_action": 1}


def test_an_action_may_come_from_a_clock_that_is_a_little_ahead(cell: Cell) -> None:
    cell.act(age_s=-0.1)
    assert len(cell.commands) == 1
    cell.act(age_s=-0.1 - 1e-6)
    assert (len(cell.commands), cell.drops()) == (1, {"future_action": 1})


def test_an_older_action_after_a_newer_one_is_dropped(cell: Cell) -> None:
    sent_ns = cell.clock.wall_ns
    cell.act(sent_ns=sent_ns)
    cell.go(0.05)
    cell.act(sent_ns=sent_ns - 1)
    assert (len(cell.commands), cell.drops()) == (1, {"reordered_action": 1})
    cell.act(sent_ns=sent_ns)
    assert len(cell.commands) == 2


def test_after_the_clock_was_set_back_newer_actions_count(cell: Cell) -> None:
    now_ns = cell.clock.wall_ns
    cell.control.action_ns = now_ns + 100_000_000
    cell.act()
    assert cell.drops() == {"reordered_action": 1}, "a clock may be a little ahead"
    cell.control.action_ns = now_ns + 100_001_000
    cell.act()
    assert len(cell.commands) == 1


def test_the_time_of_an_answered_action_counts_for_reordering_though_it_was_held(
    cell: Cell,
) -> None:
    sent_ns = cell.clock.wall_ns
    cell.answer = Hold(code="too_far", reason="a metre")
    cell.act(sent_ns=sent_ns)
    cell.answer = None
    cell.act(sent_ns=sent_ns - 1)
    assert cell.drops() == {"too_far": 1, "reordered_action": 1}


@pytest.mark.parametrize("size", [0, 6, 8])
def test_an_action_of_another_size_is_malformed(cell: Cell, size: int) -> None:
    message = to_action_message(np.zeros(7))
    message.data = message.data[:0].__class__("d", [0.0] * size)
    cell.receive(message)
    assert (cell.commands, cell.drops()) == ([], {"malformed": 1})
    assert cell.host.values()["error"]


def test_an_action_that_is_not_finite_is_told_apart(cell: Cell) -> None:
    cell.receive(to_action_message(np.array([np.nan, 0, 0, 0, 0, 0, 1.0])))
    assert (cell.commands, cell.drops()) == ([], {"non_finite": 1})
    assert cell.host.values()["error"]
    assert cell.asked == []
