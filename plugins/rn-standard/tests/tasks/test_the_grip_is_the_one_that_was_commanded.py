"""Kept is what was commanded last, by whomever; blocked fingers hold something, and what they lose
is told.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import GripperProfile, JointSample, RobotProfile
from roboneuron.errors import NotReadyError
from roboneuron.modules.report import Report
from roboneuron.tools.arm.grip import Grip, is_lost
from roboneuron.tools.arm.joints import JointMover

PROFILE = RobotProfile(
    name="arm", gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)
)


class Hand:
    """A robot module's report, and fingers that are measured one place after the other."""

    def __init__(
        self,
        *measured_m: float,
        commanded: float | None = None,
        holding: str = "",
        stamps_ns: tuple[int, ...] = (0,),
    ) -> None:
        self.measured_m = list(measured_m)
        self.stamps_ns = list(stamps_ns)
        metrics = {} if commanded is None else {"gripper_commanded": f"{commanded:g}"}
        report = Report(metrics=metrics, detail={"holding": holding} if holding else {})
        self.host: Any = SimpleNamespace(
            config=SimpleNamespace(namespace="arm"),
            modules=SimpleNamespace(view=lambda kind: SimpleNamespace(report=report)),
        )

    def joints(self, exposed: Any, timeout_s: float) -> JointSample | None:
        if not self.measured_m:
            return None
        position = self.measured_m.pop(0) if len(self.measured_m) > 1 else self.measured_m[0]
        stamp_ns = self.stamps_ns.pop(0) if len(self.stamps_ns) > 1 else self.stamps_ns[0]
        return JointSample(names=("finger",), position=np.array([position]), stamp_ns=stamp_ns)


def grip(hand: Hand, profile: RobotProfile = PROFILE, namespace: str = "arm") -> Grip:
    gate: Any = hand
    exposed: Any = SimpleNamespace(profile=profile, namespace=namespace)
    return Grip(hand.host, gate, exposed)


def test_kept_is_the_commanded_opening_and_not_that_of_blocked_fingers() -> None:
    assert grip(Hand(0.02, commanded=0.0)).kept() == 0.0


def test_as_measured_is_kept_when_nothing_was_commanded_and_nothing_without_a_gripper() -> None:
    assert grip(Hand(0.02)).kept() == 0.5
    assert grip(Hand(), RobotProfile(name="arm")).kept() == 1.0
    assert grip(Hand(0.02, commanded=0.0), namespace="another").kept() == 0.5, (
        "that is another robot's report"
    )
    with pytest.raises(NotReadyError, match="not measured"):
        grip(Hand()).kept()


@pytest.mark.parametrize("position", [math.nan, math.inf, -math.inf])
def test_a_position_that_is_not_finite_is_no_opening(position: float) -> None:
    with pytest.raises(NotReadyError, match="not measured"):
        grip(Hand(position)).kept()
    assert grip(Hand(position, commanded=0.0)).holding() is None


@pytest.mark.parametrize(("position", "is_grasped"), [(0.02, True), (math.inf, False)])
def test_an_infinite_position_is_no_object_in_the_hand(position: float, is_grasped: bool) -> None:
    """A gripper that an object keeps from closing has arrived."""
    mover: Any = SimpleNamespace(_grip_of={"finger": grip(Hand(position))})
    joints = JointSample(names=("finger",), position=np.array([position]))
    left = JointMover._left(mover, {"finger": 0.0}, joints)
    assert left == ({} if is_grasped else {"finger": 0.0})


@pytest.mark.parametrize(
    ("hand", "holds"),
    [
        (Hand(0.02, commanded=0.0), True),
        (Hand(0.0003, commanded=0.0), False),
        (Hand(0.04, commanded=1.0), False),
        (Hand(0.03, 0.03, 0.02, 0.01, 0.0, commanded=0.0), False),
        (Hand(0.02), None),
        (Hand(commanded=0.0), None),
        (Hand(0.04, commanded=1.0, holding="true"), True),
        (Hand(0.02, commanded=0.0, holding="false"), False),
    ],
    ids=[
        "blocked",
        "closed",
        "open",
        "still closing",
        "never commanded",
        "unmeasured",
        "driver: yes",
        "driver: no",
    ],
)
def test_fingers_that_rest_wider_than_commanded_hold_something(
    hand: Hand, holds: bool | None
) -> None:
    assert grip(hand).holding() is holds


@pytest.mark.parametrize(
    ("measured_m", "holds"), [((0.02,), None), ((0.02,) * 10 + (0.0,), False)], ids=["only", "late"]
)
def test_one_measurement_that_is_read_again_shows_no_rest(
    measured_m: tuple[float, ...], holds: bool | None
) -> None:
    hand = Hand(*measured_m, commanded=0.0, stamps_ns=(5_000_000_000,))
    assert grip(hand).holding() is holds


def test_rest_is_judged_by_the_times_of_measurements() -> None:
    hand = Hand(0.02, commanded=0.0, stamps_ns=(5_000_000_000, 5_000_000_000, 5_060_000_000))
    assert grip(hand).holding() is True


def test_lost_is_what_was_held_before_and_nobody_let_go() -> None:
    assert is_lost(True, False, None, 0.0)
    assert is_lost(True, False, 0.0, 0.0)
    assert not is_lost(True, False, 1.0, 0.0)
    assert not is_lost(True, None, None, 0.0)
    assert not is_lost(False, False, None, 0.0)
