"""A control that executes every space, on a test clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from control_cell import ARM, START, Cell, MakeHost, duration_s

from roboneuron.contract import EE_DELTA, Channel, ControlSpace
from roboneuron.ros.messages import to_action_message

PERIOD_S = 0.05
SPEED = 0.2
"""Speed of a joint [rad/s]."""
FASTEST, QUICKEST = 1.0, 40.0
"""Limits of velocity and acceleration: a joint reaches its limit within half of a period."""


def joints_space(kind: str, *names: str, rate_hz: float = 0.0) -> ControlSpace:
    unit = "rad/s" if kind == "joint_velocity" else "rad"
    channels = tuple(Channel(name=name, unit=unit) for name in names)
    return ControlSpace(kind=kind, channels=channels, rate_hz=rate_hz)


POSITIONS = joints_space("joint_position", *ARM)
VELOCITIES = joints_space("joint_velocity", *ARM, rate_hz=1.0 / PERIOD_S)
STEADY = replace(POSITIONS, rate_hz=1.0 / PERIOD_S)
POSES = ControlSpace(
    kind="ee_pose",
    channels=tuple(Channel(name=name, unit="", frame="base") for name in "xyz")
    + tuple(Channel(name=f"q{name}", unit="1", frame="base") for name in "xyzw"),
)
ROWS = {
    EE_DELTA: [0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    POSES: [0.51, -0.5, 0.0, 0.0, 0.0, 0.0, 1.0],
    POSITIONS: [0.51, -0.5],
    VELOCITIES: [SPEED, 0.0],
}
each_space = pytest.mark.parametrize("space", ROWS, ids=lambda space: space.kind)


class SpaceCell(Cell):
    """A control that executes every space, and an arm that follows its commands exactly."""

    def __init__(self, make_host: MakeHost, **options: Any) -> None:
        self._path = [(0.0, START, START, 1.0)]
        super().__init__(make_host, replace={'"adder"': '"follower"'}, **options)

    def send(self, space: ControlSpace, row: Sequence[float] | None = None) -> None:
        """Deliver a row; the arm follows the resulting command."""
        count = len(self.messages)
        self.receive(to_action_message(np.array(ROWS[space] if row is None else row), space))
        self._follow(count)

    def look(self) -> None:
        """Run the watchdog's check."""
        count = len(self.messages)
        self.watch()
        self._follow(count)

    def go(self, seconds: float, *, measured: bool = True) -> None:
        self.clock.go(seconds)
        self.position = self.place()
        if measured:
            self.measure()

    def place(self) -> np.ndarray:
        """Position of the arm."""
        sent_s, start, end, lasts_s = self._path[-1]
        share = min(1.0, (self.clock.now_s - sent_s) / lasts_s)
        return np.asarray(start + (end - start) * share)

    def speed(self) -> float:
        """Speed of the fastest joint in the newest command [rad/s]."""
        _, start, end, lasts_s = self._path[-1]
        return float(np.abs(end - start).max()) / lasts_s

    def _follow(self, count: int) -> None:
        for message in self.messages[count:]:
            end = np.array(message.points[0].positions)
            self._path.append((self.clock.now_s, self.place(), end, duration_s(message)))
