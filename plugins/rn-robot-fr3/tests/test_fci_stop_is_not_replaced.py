"""A stop is sent once, and a motion requested during it waits for its end."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from rn_robot_fr3.fci.arm import ClientError, FciArm, quaternion
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.planner import plan
from rn_robot_fr3.profile import HOME_RAD


class Told(FciArm):
    """Records messages to the control process."""

    def __init__(self) -> None:
        super().__init__(FciDriverOptions(host="10.0.0.1"))
        self.told: list[str] = []
        self.moves(False)

    def _send(self, message: dict[str, Any]) -> None:
        self.told.append(message["do"])

    def moves(self, is_moving: bool) -> None:
        """Set whether the process reports motion."""
        self._take({"moving": is_moving, "number": self._aimed, "realtime": False})


@pytest.fixture
def arm() -> Told:
    return Told()


def go(arm: FciArm) -> None:
    home = np.array(HOME_RAD)
    arm.go(plan(home, home + 0.1, 1.0, 0.3))


def test_a_second_stop_leaves_the_first_one_alone(arm: Told) -> None:
    go(arm)
    arm.stop()
    arm.stop()
    assert arm.told == ["go", "brake"]


def test_an_arm_that_stands_is_not_stopped(arm: Told) -> None:
    arm.stop()
    assert arm.told == []


def test_a_motion_that_was_told_counts_as_moving_before_the_process_says_so(arm: Told) -> None:
    go(arm)
    assert arm.is_moving
    arm.moves(False)
    assert not arm.is_moving


def test_a_motion_waits_for_the_end_of_the_stop(arm: Told) -> None:
    go(arm)
    arm.moves(True)
    arm.stop()
    waiting = threading.Thread(target=arm.await_rest)
    waiting.start()
    waiting.join(0.05)  # to show that nothing happens
    assert waiting.is_alive()
    arm.moves(False)
    waiting.join(5.0)
    assert not waiting.is_alive()
    go(arm)
    arm.stop()
    assert arm.told == ["go", "brake", "go", "brake"]


def test_nobody_waits_where_no_stop_was_asked_for(
    arm: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    go(arm)
    arm.moves(True)
    slept: list[float] = []
    monkeypatch.setattr("rn_robot_fr3.fci.arm.time.sleep", slept.append)
    arm.await_rest()
    assert slept == []


def test_what_ended_a_motion_is_raised_once(arm: Told) -> None:
    go(arm)
    arm._take({"ended": "ControlException", "text": 'aborted ["joint_reflex"]'})
    arm.moves(False)
    with pytest.raises(ClientError, match="joint_reflex") as raised:
        arm.read()
    assert raised.value.kind == "ControlException"
    assert not arm.is_moving


@pytest.mark.parametrize("turn", [0.0, 0.7, 3.1])
def test_the_orientation_of_the_end_effector_is_a_unit_quaternion(turn: float) -> None:
    rotation = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]]
    )
    assert quaternion(rotation) == pytest.approx([0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)])
