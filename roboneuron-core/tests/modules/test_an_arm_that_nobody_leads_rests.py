"""Control brakes an arm that is led no more, by the clock of the test and with an arm that lags."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from control_cell import Cell, MakeHost, duration_s
from std_msgs.msg import Float64MultiArray

from rn_simulation.setpoint import JointSetpoint
from rn_standard.teleoperation import in_control
from rn_standard.teleoperation.rows import Acting, LeadRow, Mode, RowKind
from roboneuron.direct_path.exposed import ACTING_TOPIC

TICK_S, ROW_S, LAG_TICKS = 0.005, 0.02, 4
REST_S, GONE_S = 0.2, 1.0
STILL = 0.005
"""What the arm accelerates by in a tick [rad/s]."""
FAST_M_S = 0.25
"""As fast as a person may ask for; the arm of the cell accelerates with 1 rad/s^2."""


class LedCell(Cell):
    """Its arm follows the commands within its limits, and is measured 20 ms late."""

    def __init__(self, make_host: MakeHost, **options: Any) -> None:
        super().__init__(make_host, activate=False, **options)
        in_control.join(self.host)
        self.host.on_configured[-1](self.control)
        self.arm = JointSetpoint(self.position, np.ones(2), np.ones(2))
        self.past = [self.position.copy()] * LAG_TICKS
        self.velocities: list[tuple[float, float]] = []
        self.number = self.ticks = self.seen = 0
        self.control.activate()
        self.measure()

    def lead(
        self, kind: RowKind = "twist", mode: Mode = "person", gripper_open: float | None = None
    ) -> None:
        self.number += 1
        twist = np.array([FAST_M_S, 0, 0, 0, 0, 0])
        row = LeadRow(
            session="one",
            number=self.number,
            mode=mode,
            kind=kind,
            keys=("base",) if kind == "twist" else (),
            values=twist if kind == "twist" else np.zeros(0),
            gripper_open=gripper_open,
        )
        info = {"source_timestamp": self.clock.wall_ns}
        self.host.subscribed[Float64MultiArray, "lead"](row.to_message(), info)

    def run(self, seconds: float, each_row: Callable[[], None] = lambda: None) -> None:
        """Let time pass, with a row in each period."""
        for _ in range(round(seconds / TICK_S)):
            if self.ticks % round(ROW_S / TICK_S) == 0:
                each_row()
            self.ticks += 1
            self.clock.go(TICK_S)
            for message in self.messages[self.seen :]:
                self.arm.aim(np.array(message.points[0].positions), (0, 1), duration_s(message))
            self.seen = len(self.messages)
            self.arm.advance(TICK_S)
            self.past.append(self.arm.position.copy())
            self.position = self.past[-1 - LAG_TICKS]
            self.velocities.append((self.clock.now_s, float(self.arm.velocity[0])))
            self.measure()
            for period_s, callback in self.host.repeated:
                if self.ticks % round(period_s / TICK_S) == 0:
                    callback()

    def acting(self) -> Acting:
        """What control reported last."""
        return Acting.from_message(self.host.publishers[ACTING_TOPIC].messages[-1])

    def rest_s(self, since_s: float) -> float:
        moving = [at for at, speed in self.velocities if at > since_s and abs(speed) > STILL]
        return max(moving, default=since_s) - since_s


@pytest.fixture
def cell(make_host: MakeHost, monkeypatch: pytest.MonkeyPatch) -> LedCell:
    """Whose arm is led as fast as it may be."""
    made = LedCell(make_host)
    monkeypatch.setattr(in_control, "time", made.clock)
    made.lead("rest")
    made.run(0.5, made.lead)
    assert made.arm.velocity[0] > 0.05
    return made


ENDS: dict[str, Callable[[LedCell], None]] = {
    "the page is closed": lambda cell: cell.lead("rest", "lost"),
    "the switch is released": lambda cell: cell.run(0.3, lambda: cell.lead("still")),
    "the server is gone": lambda cell: None,
}


@pytest.mark.parametrize("end", ENDS)
def test_the_arm_rests_in_time_and_does_not_return(cell: LedCell, end: str) -> None:
    ended_s, begun = cell.clock.now_s, len(cell.velocities)
    cell.run(ROW_S)
    ENDS[end](cell)
    cell.run(2.0 * GONE_S)
    assert cell.rest_s(ended_s) <= REST_S
    assert min(speed for _, speed in cell.velocities[begun:]) > -STILL
    assert "the lead was lost" in cell.host.needs_start


def test_a_row_that_is_late_slows_the_arm_down_and_the_next_one_leads_it_on(
    cell: LedCell,
) -> None:
    cell.run(0.1)
    assert abs(cell.arm.velocity[0]) < 0.03
    begun_s = cell.clock.now_s
    cell.run(0.2, cell.lead)
    assert cell.velocities[-1][1] > 0.05
    assert cell.rest_s(begun_s) > 0.15
    assert not cell.host.needs_start


def test_nothing_but_the_braking_moves_an_arm_whose_lead_is_lost(cell: LedCell) -> None:
    cell.lead("rest", "lost")
    cell.act(-0.01)
    cell.lead()
    assert cell.drops() == {"taken_over": 1, "lead_ended": 1}
    cell.run(1.5 * REST_S)
    assert cell.code == "lead_lost"
    assert "the lead was lost" in cell.host.needs_start
    cell.act(-0.01)
    assert cell.drops()["needs_new_start"] == 1


def test_control_reports_who_moves_the_arm_and_what_limits_it(make_host: MakeHost) -> None:
    cell = LedCell(make_host, extra="[limits]\nmax_speed_m_s = 0.05\n")
    cell.act(0.001)
    assert (cell.acting().who, cell.acting().share, cell.acting().limits) == ("policy", 1.0, "")
    cell.run(ROW_S, lambda: cell.act(0.1))
    limited = cell.acting()
    assert limited.who == "policy"
    assert 0.0 < limited.share < 1.0
    assert limited.limits
    cell.host.stopped = True
    cell.act(0.001)
    assert (cell.acting().who, cell.acting().share) == ("nobody", 1.0)
    assert cell.acting().note


def test_control_reports_the_row_that_it_carried_out_and_what_it_commanded(cell: LedCell) -> None:
    cell.run(ROW_S, lambda: cell.lead(gripper_open=0.5))
    led = cell.acting()
    assert (led.who, led.session, led.number) == ("person", "one", cell.number)
    assert led.gripper_open == 0.5
    assert len(led.moved) == 6
    assert not led.note
    cell.run(ROW_S, cell.lead)
    assert cell.acting().gripper_open is None
    assert cell.acting().number == led.number + 1


def test_nothing_that_a_person_commanded_is_reported_of_the_policy(cell: LedCell) -> None:
    cell.lead("rest", gripper_open=0.5)
    cell.run(0.1)
    cell.lead("rest", "lost")
    assert cell.acting().moved == ()
    assert cell.acting().gripper_open is None
