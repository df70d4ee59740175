"""Changes by `roboneuron link` affect open connections within two seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from link_machines import Machine as Namespace
from link_machines import Talker, impossible, machines
from link_pairs import pair

from rn_link.keys import remove_all, remove_peer
from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
CUT_OFF_S = 2.0
"""The relay checks twice a second; the rest is for a busy machine."""
CONNECT_S = 20.0


class Cell:
    """A robot with two members, and a process on each."""

    def __init__(self, robot: Namespace, gpu: Namespace, lab: Namespace) -> None:
        self.robot, self.gpu, self.lab = robot, gpu, lab
        for member in (gpu, lab):
            pair(robot, member)
        self.near, self.far, self.other = (one.talk(one.name) for one in (robot, gpu, lab))
        for talker, name in (
            (self.near, "gpu"),
            (self.near, "lab"),
            (self.far, "robot"),
            (self.other, "robot"),
        ):
            talker.wait_for(name, 5, CONNECT_S)


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    with machines(tmp_path, "robot", "gpu", "lab") as made:
        yield Cell(made["robot"], made["gpu"], made["lab"])


def check_cut_off(*pairs: tuple[Talker, str]) -> None:
    """Check that none of these pairs receives messages after CUT_OFF_S, although both keep
    publishing.
    """
    until_s = time.monotonic() + CUT_OFF_S
    wait_until(lambda: time.monotonic() > until_s, 10.0, "the time it may take")
    heard = [talker.heard(name) for talker, name in pairs]
    for talker, _ in pairs:
        talker.wait_for(talker.name, 60, 20.0)
    assert [talker.heard(name) for talker, name in pairs] == heard


def test_a_removed_member_is_cut_off_and_the_others_are_not(cell: Cell) -> None:
    remove_peer(cell.robot.link, "gpu")
    check_cut_off((cell.near, "gpu"), (cell.far, "robot"))
    cell.near.wait_for("lab", 20, 5.0)
    assert cell.near.longest_gap_s("lab") < CUT_OFF_S
    assert "Linked to lab" not in cell.near.log.read_text().partition("Linked to gpu")[2][20:]


def test_a_member_that_leaves_is_cut_off(cell: Cell) -> None:
    remove_all(cell.gpu.link)
    check_cut_off((cell.near, "gpu"), (cell.far, "robot"))


def test_a_machine_that_is_paired_again_is_linked_without_a_restart(cell: Cell) -> None:
    remove_peer(cell.robot.link, "gpu")
    check_cut_off((cell.near, "gpu"), (cell.far, "robot"))
    pair(cell.robot, cell.gpu)
    for talker, name in ((cell.near, "gpu"), (cell.far, "robot"), (cell.other, "robot")):
        talker.wait_for(name, 5, CONNECT_S)
