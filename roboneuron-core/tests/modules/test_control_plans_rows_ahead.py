"""Rows planned after the current one are limited one after the other and sent with it, within a
horizon; on a test clock.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import loop_plugin
import numpy as np
import pytest
from control_cell import ARM, START, STOPS, Cell, MakeHost
from std_msgs.msg import MultiArrayDimension

from roboneuron.contract import (
    Channel,
    ControlSpace,
    Hold,
    JointCommand,
    JointLimits,
    JointSample,
)
from roboneuron.errors import ConfigurationError
from roboneuron.ros.messages import PlannedRows, to_action_message

PERIOD_S = 0.05
HORIZON_S = 0.15
SPEED, FASTEST = 0.2, 0.5
"""Speeds of the policy and of the limits [rad/s]."""
SPACE = ControlSpace(
    kind="joint_position",
    channels=tuple(Channel(name=name, unit="rad") for name in ARM),
    rate_hz=1.0 / PERIOD_S,
)
DELTAS = np.array([0.01, 0, 0, 0, 0, 0, 1.0])


def row(number: int, speed: float = SPEED) -> np.ndarray:
    """Row `number`, starting at 1, of a steady motion of the first joint."""
    return START + np.array([number * PERIOD_S * speed, 0.0])


class PlanCell(Cell):
    """A control that executes positions, with a horizon."""

    def __init__(self, make_host: MakeHost, extra: str = f"horizon_s = {HORIZON_S}\n") -> None:
        settings = {"action_timeout_s = 0.3": f"action_timeout_s = 0.4\n{extra}"}
        super().__init__(make_host, replace={'"adder"': '"follower"', **settings})

    def chunk(self, *numbers: int, speed: float = SPEED) -> None:
        """Deliver a row with the following planned ones."""
        first, *later = (row(number, speed) for number in numbers)
        planned = PlannedRows(rows=np.array(later).reshape(-1, 2), step_s=PERIOD_S)
        self.receive(to_action_message(first, SPACE, planned))

    @property
    def ends(self) -> list[float]:
        """Displacements of the first joint at the points of the newest command."""
        return [float(p.positions[0]) - START[0] for p in self.messages[-1].points]

    @property
    def times_s(self) -> list[float]:
        points = self.messages[-1].points
        return [p.time_from_start.sec + p.time_from_start.nanosec / 1e9 for p in points]


@pytest.fixture(autouse=True)
def quick_joints(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make joints reach their velocity within a row."""
    one = np.ones(2)
    limits = JointLimits(
        lower=-2 * one,
        upper=2 * one,
        velocity=FASTEST * one,
        acceleration=40 * one,
        effort=one,
    )
    profile = replace(loop_plugin.profile(), limits=limits)
    monkeypatch.setattr(loop_plugin, "profile", lambda: profile)


@pytest.fixture
def cell(make_host: MakeHost) -> PlanCell:
    return PlanCell(make_host)


def test_rows_within_the_horizon_are_sent_with_the_one_that_is_due(cell: PlanCell) -> None:
    cell.chunk(1, 2, 3, 4, 5, 6)
    assert cell.times_s == pytest.approx([0.05, 0.1, 0.15, 0.2])
    assert cell.ends == pytest.approx([0.01, 0.02, 0.03, 0.04])
    assert len(cell.messages) == 1


def test_the_next_row_replaces_the_plan_from_where_the_arm_is_led(cell: PlanCell) -> None:
    cell.chunk(1, 2, 3)
    cell.position = row(1)
    cell.go(PERIOD_S)
    cell.chunk(2, 3)
    assert cell.ends == pytest.approx([0.02, 0.03])
    assert cell.times_s == pytest.approx([0.05, 0.1])


def test_without_a_horizon_a_row_is_sent_alone(make_host: MakeHost) -> None:
    cell = PlanCell(make_host, extra="")
    cell.chunk(1, 2, 3)
    assert cell.ends == pytest.approx([0.01])


def test_displacements_are_not_planned(cell: PlanCell) -> None:
    """Each is relative to the measured arm, so executing one early would count it twice."""
    planned = PlannedRows(rows=np.array([DELTAS, DELTAS]), step_s=PERIOD_S)
    cell.receive(to_action_message(DELTAS, planned=planned))
    assert cell.ends == pytest.approx([0.01])


def test_no_planned_row_is_faster_than_the_limits(cell: PlanCell) -> None:
    """The first row is within the velocity limit, the later ones are not."""
    planned = PlannedRows(rows=np.array([row(8), row(40)]), step_s=PERIOD_S)
    cell.receive(to_action_message(row(1), SPACE, planned))
    ends, times_s = [0.0, *cell.ends], [0.0, *cell.times_s]
    assert len(cell.ends) == 3
    assert np.all(np.diff(ends) / np.diff(times_s) <= FASTEST + 1e-6)
    assert cell.ends[-1] < 40 * PERIOD_S * SPEED


def test_a_planned_row_that_cannot_be_executed_ends_the_plan(
    cell: PlanCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller: Any = cell.control.controller
    execute = controller.execute

    def refuse_third(
        space: ControlSpace, values: np.ndarray, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        if values[0] == row(3)[0]:
            return Hold(code="joint_jump", reason="too far")
        return execute(space, values, joints, step_s)

    monkeypatch.setattr(controller, "execute", refuse_third)
    cell.chunk(1, 2, 3, 4)
    assert cell.ends == pytest.approx([0.01, 0.02])
    assert "joint_jump" not in cell.drops()


def test_a_planned_row_is_computed_from_where_the_one_before_ends(
    cell: PlanCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller: Any = cell.control.controller
    execute, starts = controller.execute, []

    def note(
        space: ControlSpace, values: np.ndarray, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        starts.append(float(joints.position[0]) - START[0])
        return execute(space, values, joints, step_s)

    monkeypatch.setattr(controller, "execute", note)
    cell.chunk(1, 2, 3)
    assert starts == pytest.approx([0.0, 0.01, 0.02])


def test_a_late_row_goes_on_from_the_planned_motion(cell: PlanCell) -> None:
    """The arm has followed the plan meanwhile; the limiter knows this, and detects no jump back."""
    cell.chunk(1, 2, 3)
    cell.position = (row(2) + row(3)) / 2
    cell.go(2.5 * PERIOD_S)
    cell.chunk(4)
    setpoint = cell.control._limiter._sent
    assert setpoint is not None
    assert setpoint.start[0] - START[0] == pytest.approx(0.025)
    assert cell.ends == pytest.approx([0.04])


@pytest.mark.parametrize("cause", STOPS)
def test_no_plan_is_sent_in_a_stop(cell: PlanCell, cause: str) -> None:
    STOPS[cause](cell)
    cell.chunk(1, 2, 3)
    assert cell.messages == []
    assert cause in cell.drops()


def test_an_emergency_stop_replaces_the_plan_by_the_measured_posture(cell: PlanCell) -> None:
    cell.chunk(1, 2, 3)
    cell.position = row(1)
    cell.go(PERIOD_S)
    cell.host.stopped = True
    cell.control.stop("emergency_stop")
    assert cell.ends == pytest.approx([0.01])
    cell.host.stopped = False
    cell.go(PERIOD_S)
    cell.chunk(2)
    setpoint = cell.control._limiter._sent
    assert setpoint is not None
    assert setpoint.start[0] - START[0] == pytest.approx(0.01), "the plan of before counts no more"


@pytest.mark.parametrize("ahead", [(2,), (2, 3)])
def test_a_refused_row_withdraws_what_was_planned_before(
    cell: PlanCell, monkeypatch: pytest.MonkeyPatch, ahead: tuple[int, ...]
) -> None:
    cell.chunk(1, *ahead)
    cell.position = row(1)
    cell.go(PERIOD_S)
    monkeypatch.setattr(cell.control, "_limit", lambda *_: None)
    cell.chunk(2, 3)
    assert cell.ends == pytest.approx([0.01])
    assert cell.code == "plan_withdrawn"


@pytest.mark.parametrize("damage", ["label", "rate", "size", "nan", "third"])
def test_planned_rows_that_are_none_make_the_action_malformed(cell: PlanCell, damage: str) -> None:
    planned = PlannedRows(rows=np.array([row(2), row(3)]), step_s=PERIOD_S)
    message = to_action_message(row(1), SPACE, planned)
    if damage == "label":
        message.layout.dim[1].label = "rows"
    elif damage == "rate":
        message.layout.dim[1].label = "planned@0"
    elif damage == "size":
        message.layout.dim[1].size = 3
    elif damage == "nan":
        message.data[3] = float("nan")
    else:
        message.layout.dim.append(MultiArrayDimension(label="more", size=1, stride=1))
    cell.receive(message)
    assert cell.messages == []
    assert cell.drops() == {"non_finite" if damage == "nan" else "malformed": 1}


def test_a_message_of_very_many_rows_is_bounded(cell: PlanCell) -> None:
    planned = PlannedRows(rows=np.tile(row(2), (5000, 1)), step_s=1e-3)
    cell.receive(to_action_message(row(1), SPACE, planned))
    assert len(cell.ends) <= 51


@pytest.mark.parametrize(
    ("extra", "told"),
    [
        ("horizon_s = 0.31\n", "at most 0.3 "),
        ("horizon_s = 0.1\ncommand = 'joint_state'\n", "carries no times"),
    ],
)
def test_a_horizon_that_does_not_fit_is_refused(make_host: MakeHost, extra: str, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        PlanCell(make_host, extra)
