"""Joint commands: named joints, and the current setpoint of the last one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from roboneuron.contract import JointCommand, JointSample
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion.command import Setpoint, pick, pick_others
from roboneuron.gate.motion.joint_space import JointLimit

ARM = ("a", "b")
LIMITS = {"finger": JointLimit(lower=0.0, upper=0.04), "thumb": JointLimit(lower=-1.0, upper=1.0)}


def others(
    names: tuple[str, ...],
    position: list[float],
    measured_names: tuple[str, ...],
    measured: list[float],
) -> dict[str, float]:
    command = JointCommand(names=names, position=np.array(position), duration_s=0.1)
    joints = JointSample(names=measured_names, position=np.array(measured))
    found, values = pick_others(command, joints, ARM, LIMITS)
    assert values.dtype == np.float64
    assert values.shape == (len(found),)
    return dict(zip(found, values.tolist(), strict=True))


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a"), ("c", "b", "a")])
def test_positions_are_picked_by_name_in_the_order_asked_for(names: tuple[str, ...]) -> None:
    position = np.array([{"a": 1, "b": 2, "c": 3}[name] for name in names])
    found = pick(names, position, ARM)
    assert found.tolist() == [1.0, 2.0]
    assert found.dtype == np.float64


@pytest.mark.parametrize(
    ("names", "position", "text"),
    [
        (("a", "b"), [1.0], "2 joints are named, 2 different, with positions of shape .1,"),
        (("a", "b"), [1.0, 2.0, 3.0], "of shape .3,"),
        (("a", "b"), [[1.0, 2.0]], "of shape .1, 2"),
        (("a", "b", "b"), [1.0, 2.0, 2.0], "3 joints are named, 2 different"),
        (("a", "c"), [1.0, 2.0], "lack .'b'. of the arm"),
        ((), [], "lack .'a', 'b'. of the arm"),
    ],
)
def test_positions_that_do_not_fit_their_names_are_unsafe(
    names: tuple[str, ...], position: list[float], text: str
) -> None:
    with pytest.raises(UnsafeError, match=text):
        pick(names, np.array(position), ARM)


@pytest.mark.parametrize(
    ("value", "is_possible"), [(1e4, True), (10_000.1, False), (math.nan, False), (math.inf, False)]
)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])
def test_no_joint_is_farther_than_ten_thousand_from_zero(
    value: float, is_possible: bool, sign: float, names: tuple[str, ...]
) -> None:
    if is_possible:
        assert sign * value in pick(names, np.array([0.0, sign * value]), ARM).tolist()
        return
    with pytest.raises(UnsafeError, match="no possible position"):
        pick(names, np.array([0.0, sign * value]), ARM)


def test_a_joint_beside_the_arm_may_be_anywhere_when_only_the_arm_is_picked() -> None:
    assert pick(("a", "b", "wheel"), np.array([1.0, 2.0, 1e9]), ARM).tolist() == [1.0, 2.0]


def test_an_arm_alone_has_no_other_joints() -> None:
    assert others(ARM, [1.0, 2.0], ARM, [0.0, 0.0]) == {}
    assert others(("b", "a"), [1.0, 2.0], ("b", "a"), [0.0, 0.0]) == {}


def test_other_joints_are_as_commanded_and_else_as_measured() -> None:
    measured = ("finger", "a", "thumb", "b", "wheel")
    assert others(ARM, [1.0, 2.0], measured, [0.01, 8.0, 0.5, 9.0, 7.0]) == {
        "finger": 0.01,
        "thumb": 0.5,
        "wheel": 7.0,
    }
    commanded = others(("a", "thumb", "b"), [1.0, -0.25, 2.0], measured, [0.01, 8.0, 0.5, 9.0, 7.0])
    assert commanded == {"finger": 0.01, "thumb": -0.25, "wheel": 7.0}


def test_a_commanded_joint_need_not_be_measured() -> None:
    assert others(("a", "b", "finger"), [1.0, 2.0, 0.03], ARM, [0.0, 0.0]) == {"finger": 0.03}


@pytest.mark.parametrize(
    ("value", "is_kept"),
    [(1e4, True), (-1e4, True), (1.1e4, False), (-1.1e4, False), (math.nan, False)],
)
def test_measured_joints_at_no_possible_position_are_left_out(value: float, is_kept: bool) -> None:
    assert others(ARM, [1.0, 2.0], ("a", "b", "wheel"), [0.0, 0.0, value]) == (
        {"wheel": value} if is_kept else {}
    )


@pytest.mark.parametrize(
    ("opening", "is_allowed"), [(0.0, True), (0.04, True), (0.0401, False), (-0.0001, False)]
)
def test_a_commanded_gripper_stays_within_its_travel(opening: float, is_allowed: bool) -> None:
    if is_allowed:
        assert others(("finger", "a", "b"), [opening, 1.0, 2.0], ARM, [0.0, 0.0]) == {
            "finger": opening
        }
        return
    with pytest.raises(
        UnsafeError, match=r"The gripper would go to .*, its travel is 0 \.\. 0\.04"
    ):
        others(("a", "b", "finger"), [1.0, 2.0, opening], ARM, [0.0, 0.0])


def test_a_joint_that_nobody_knows_is_not_commanded() -> None:
    with pytest.raises(UnsafeError, match="names the joint 'wheel'"):
        others(("a", "b", "wheel"), [1.0, 2.0, 0.0], ("a", "b", "wheel"), [0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("now_s", "position", "velocity"),
    [
        (9.0, 1.0, 2.0),  # a clock that went back: it has not begun
        (10.0, 1.0, 2.0),
        (10.125, 1.25, 2.0),
        (10.499, 1.998, 2.0),
        (10.5, 2.0, 2.0),
        (10.75, 2.0, 1.0),
        (11.0, 2.0, 0.0),
        (99.0, 2.0, 0.0),
    ],
)
def test_a_setpoint_moves_evenly_and_brakes_at_its_end(
    now_s: float, position: float, velocity: float
) -> None:
    setpoint = Setpoint(
        start=np.ones(1),
        displacement=np.ones(1),
        duration_s=0.5,
        sent_s=10.0,
        immediate=False,
        goal=np.ones(1),
        goal_velocity=np.ones(1),
    )
    where, speed = setpoint.at(now_s, np.array([4.0]))
    assert where.tolist() == pytest.approx([position])
    assert speed.tolist() == [velocity]


def test_a_setpoint_without_a_limit_of_acceleration_rests_at_its_end() -> None:
    setpoint = Setpoint(
        start=np.zeros(2),
        displacement=np.array([-1.0, 0.0]),
        duration_s=0.5,
        sent_s=10.0,
        immediate=False,
        goal=np.zeros(2),
        goal_velocity=np.zeros(2),
    )
    endless = np.full(2, np.inf)
    assert setpoint.at(10.5, endless)[1].tolist() == [-2.0, 0.0]
    assert setpoint.at(10.501, endless)[1].tolist() == [0.0, 0.0]
    assert setpoint.at(10.75, np.full(2, 4.0))[1].tolist() == [-1.0, 0.0]


@pytest.mark.parametrize(
    ("now_s", "velocity"), [(10.0, 2.0), (10.75, 2.0), (11.0, 2.0), (11.25, 1.0), (99.0, 0.0)]
)
def test_an_immediate_setpoint_is_there_at_once_and_moves_until_the_next_one_is_due(
    now_s: float, velocity: float
) -> None:
    setpoint = Setpoint(
        start=np.ones(1),
        displacement=np.ones(1),
        duration_s=0.5,
        sent_s=10.0,
        immediate=True,
        goal=np.ones(1),
        goal_velocity=np.ones(1),
    )
    where, speed = setpoint.at(now_s, np.array([4.0]))
    assert (where.tolist(), speed.tolist()) == ([2.0], [velocity])
