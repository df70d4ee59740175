"""The Franka Hand closes with force on any object, and keeps the force until it is to open."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from rn_robot_fr3.fci.gripper import FciGripper
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_testing.waiting import wait_until

OBJECT_M = 0.04


class Done:
    """A future that is done at once."""

    def __init__(self, value: bool) -> None:
        self._value = value

    def wait(self, timeout_s: float) -> bool:
        return True

    def get(self) -> bool:
        return self._value


class Hand:
    """A Franka Hand around an object, as franky presents it: a blocked motion ends without
    force.
    """

    def __init__(self, *, is_grasped: bool = False) -> None:
        self.state = SimpleNamespace(
            width=OBJECT_M if is_grasped else 0.08,
            max_width=0.08,
            is_grasped=is_grasped,
            object_m=OBJECT_M,
        )
        self.calls: list[tuple[str, float]] = []

    def move_async(self, width_m: float, speed: float) -> Done:
        self.calls.append(("move", width_m))
        self.state.width, self.state.is_grasped = max(width_m, self.state.object_m), False
        return Done(width_m >= self.state.object_m)

    def grasp_async(
        self, width_m: float, speed: float, force: float, inner: float, outer: float
    ) -> Done:
        self.calls.append(("grasp", force))
        self.state.width = self.state.object_m
        self.state.is_grasped = self.state.object_m > 0.0
        return Done(True)


Make = Callable[[Hand], FciGripper]


@pytest.fixture
def make() -> Iterator[Make]:
    """Return a function that opens the gripper on a hand."""
    made: list[FciGripper] = []

    def build(hand: Hand) -> FciGripper:
        client: Any = SimpleNamespace(Gripper=lambda host: hand)
        gripper = FciGripper(FciDriverOptions(host="127.0.0.1"), client)
        made.append(gripper)
        gripper.open()
        return gripper

    yield build
    for gripper in made:
        gripper.close()


def await_note(gripper: FciGripper, note: str) -> None:
    wait_until(lambda: gripper.note == note, 10.0, f"the note {note!r}")


def test_what_is_held_stays_held_when_the_measured_width_is_commanded(make: Make) -> None:
    hand = Hand()
    gripper = make(hand)
    gripper.aim(0.0)
    await_note(gripper, "grasped 40 mm")
    gripper.aim(OBJECT_M)
    gripper.aim(0.02)
    gripper.aim(0.0)
    gripper.aim(0.08)
    await_note(gripper, "at 80 mm")
    assert [name for name, _ in hand.calls] == ["grasp", "move"], (
        "one grasp, and it opens once it is told to"
    )
    assert not gripper.is_holding


def test_a_motion_that_something_blocks_ends_in_a_grasp(make: Make) -> None:
    hand = Hand()
    gripper = make(hand)
    gripper.aim(0.02)
    await_note(gripper, "grasped 40 mm")
    assert hand.calls == [("move", 0.02), ("grasp", 30.0)]
    assert gripper.is_holding


def test_what_the_hand_held_before_a_restart_is_not_dropped_by_its_measured_width(
    make: Make,
) -> None:
    hand = Hand(is_grasped=True)
    gripper = make(hand)
    assert (gripper.is_holding, gripper.note) == (True, "grasped 40 mm")
    gripper.aim(gripper.width_m)
    gripper.aim(0.0)
    gripper.aim(0.08)
    await_note(gripper, "at 80 mm")
    assert ("move", OBJECT_M) not in hand.calls


def test_what_slips_out_is_told(make: Make) -> None:
    hand = Hand()
    gripper = make(hand)
    gripper.aim(0.0)
    await_note(gripper, "grasped 40 mm")
    hand.state.width = 0.0
    await_note(gripper, "lost what it held")
    assert not gripper.is_holding
