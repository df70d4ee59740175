"""A cut cable, a killed process, half-open connections: the rest continues, the link reconnects."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from link_machines import Machine, impossible, machines
from link_pairs import pair

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
BACK_S = 30.0
"""A participant that was given up (lease 20 s) is discovered with its next announcement."""
GAP_S = 3.0
"""Gap between messages on the robot, which do not use the link; a busy machine causes one."""
GIVEN_UP_S = 3.5 + 4.0
"""The relay's time limit, with a margin for a busy machine."""
AGAIN_S = 5.0 + 5.0
"""As above."""


class Cell:
    """Two processes of a robot, one of which sends images, and one of its GPU machine."""

    def __init__(self, robot: Machine, gpu: Machine) -> None:
        self.robot = robot
        self.gpu = gpu
        self.far = gpu.talk("far")
        self.camera = robot.talk("camera", "--images")
        self.control = robot.talk("control")
        self.meet()

    def meet(self) -> None:
        """Wait until all receive messages from all, and check the robot's own meanwhile."""
        for talker, name in (
            (self.far, "camera's image"),
            (self.far, "control"),
            (self.camera, self.far.name),
            (self.control, self.far.name),
            (self.control, "camera's image"),
        ):
            talker.wait_for(name, 5, BACK_S)
        assert self.control.longest_gap_s("camera's image") < GAP_S


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    with machines(tmp_path, "robot", "gpu") as made:
        pair(made["robot"], made["gpu"])
        yield Cell(made["robot"], made["gpu"])


@pytest.mark.parametrize("fault", ["cut", "killed", "killed while cut"])
def test_what_is_lost_is_replaced_and_stops_nobody_on_the_robot(cell: Cell, fault: str) -> None:
    """What ends while the cable is cut does so without a word to the robot's side."""
    if "cut" in fault:
        cell.gpu.cut()
    heard = cell.far.heard("camera's image")
    if "killed" in fault:
        cell.far.end()
        cell.far = cell.gpu.talk("far-again")
    cell.control.wait_for("camera's image", 150, 30.0)
    if "cut" in fault:
        assert cell.far.heard("camera's image") <= heard + 30, "the cable is cut"
        cell.gpu.plug()
    cell.meet()


@pytest.mark.parametrize(
    ("lost", "for_s"),
    [("to the member", 8.0), ("to the hub", 8.0), ("both", 8.0), ("both", 26.0)],
)
def test_a_half_open_connection_is_given_up_and_made_again(
    cell: Cell, lost: str, for_s: float
) -> None:
    """The last duration is longer than the lease of a participant (20 s)."""
    directions = [(cell.robot, cell.gpu)] if lost != "to the hub" else []
    directions += [(cell.gpu, cell.robot)] if lost != "to the member" else []
    for sender, receiver in directions:
        sender.lose(receiver)
    begun_s = time.monotonic()
    logs = (cell.camera.log, cell.far.log)
    wait_until(
        lambda: any(log.read_text().count("no link") > 1 for log in logs), GIVEN_UP_S, "an end"
    )
    wait_until(lambda: time.monotonic() > begun_s + for_s, 60.0, "the time of the loss")
    heard = cell.far.heard("control"), cell.control.heard("far")
    for sender, receiver in directions:
        sender.find(receiver)
    wait_until(lambda: cell.far.heard("control") > heard[0], AGAIN_S, "the member hears")
    wait_until(lambda: cell.control.heard("far") > heard[1], AGAIN_S, "the robot hears")
    cell.meet()
