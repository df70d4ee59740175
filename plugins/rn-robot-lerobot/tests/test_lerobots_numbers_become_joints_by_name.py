"""Conversion of degrees, percent and range shares to radians and back, and LeRobot's own scaling of
raw numbers by the calibration file.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rn_robot_fr3.profile import pair_profile
from rn_robot_lerobot.arm import JOINTS, SO101
from rn_robot_lerobot.bus.reference import ASSEMBLED_SO101
from rn_robot_lerobot.calibration import STEPS
from rn_robot_lerobot.profile import so101_profile
from rn_robot_lerobot.units import MotorMap, degrees, motors_of, percent, share_of_range
from roboneuron import InvalidInputError, NotReadyError, UnsafeError

SCALING = json.loads(Path(__file__).parent.joinpath("data/scaling.json").read_text())["rows"]
STEP_RAD = 2.0 * math.pi / STEPS


def true_position(name: str, raw: int) -> float:
    """Joint position for the raw value `raw` with the reference calibration [rad]."""
    encoder = raw + ASSEMBLED_SO101.calibration()[name].homing_offset
    return (encoder - ASSEMBLED_SO101.encoder_zeros[name]) * STEP_RAD


@pytest.mark.parametrize("row", [row for row in SCALING if row["mode"] == "degrees"])
def test_lerobots_degrees_are_the_joints_of_the_arm(row: dict[str, object]) -> None:
    name, raw = str(row["motor"]), int(str(row["raw"]))
    if name == "gripper":
        return
    unit = degrees(name, name)
    position = unit.scale * float(str(row["value"])) + unit.offset
    # LeRobot counts 4095 steps per turn, and rounds the middle of a range to whole steps
    assert position == pytest.approx(true_position(name, raw), abs=2 * STEP_RAD)


@pytest.mark.parametrize("row", [row for row in SCALING if row["motor"] == "gripper"])
def test_lerobots_percent_are_the_jaw(row: dict[str, object]) -> None:
    if row["mode"] != "range_0_100":
        return
    unit = percent("gripper", "gripper", SO101.jaw_closed_rad, SO101.jaw_open_rad)
    position = unit.scale * float(str(row["value"])) + unit.offset
    truth = true_position("gripper", int(str(row["raw"])))
    assert position == pytest.approx(
        np.clip(truth, SO101.jaw_closed_rad, SO101.jaw_open_rad), abs=2 * STEP_RAD
    )


@pytest.mark.parametrize("row", [row for row in SCALING if row["mode"] == "range_m100_100"])
def test_lerobots_shares_of_a_range_are_the_joints(row: dict[str, object]) -> None:
    name, raw = str(row["motor"]), int(str(row["raw"]))
    motor = ASSEMBLED_SO101.calibration()[name]
    if name == "gripper" or not motor.range_min <= raw <= motor.range_max:
        return
    unit = share_of_range(name, name, motor.half_range_rad)
    position = unit.scale * float(str(row["value"])) + unit.offset
    assert position == pytest.approx(true_position(name, raw), abs=2 * STEP_RAD)


@given(
    value=st.floats(-179.0, 179.0),
    sign=st.sampled_from((-1.0, 1.0)),
    offset_rad=st.floats(-3.0, 3.0),
)
def test_sign_and_offset_are_undone_on_the_way_back(
    value: float, sign: float, offset_rad: float
) -> None:
    motors = MotorMap([degrees("m", "j", sign=sign, offset_rad=offset_rad)])
    position = motors.positions({"m.pos": value})
    assert position[0] == pytest.approx(sign * math.radians(value) + offset_rad, abs=1e-12)
    assert motors.values({"j": float(position[0])})["m.pos"] == pytest.approx(value, abs=1e-9)


def test_an_inverted_gripper_is_open_at_nought() -> None:
    motors = MotorMap([percent("g", "j", -0.1, 0.9, inverted=True)])
    assert motors.positions({"g.pos": 0.0}) == pytest.approx([0.9])
    assert motors.positions({"g.pos": 100.0}) == pytest.approx([-0.1])


def test_names_of_the_so101_are_those_of_lerobots_data_sets() -> None:
    motors = motors_of(so101_profile())
    assert motors.keys == tuple(f"{name}.pos" for name in JOINTS)
    values = dict.fromkeys(motors.keys, 90.0)
    assert motors.positions(values)[0] == pytest.approx(math.pi / 2)
    plain = motors_of(so101_profile(), use_degrees=False)
    assert plain.positions(values | dict.fromkeys(plain.keys[:5], 1.0))[0] == 1.0


def test_each_of_two_arms_has_a_gripper_of_its_own_name() -> None:
    keys = motors_of(pair_profile()).keys
    assert keys[0] == "left_fr3_joint1.pos"
    assert [key for key in keys if "gripper" in key] == ["left_gripper.pos", "right_gripper.pos"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tail.pos": 0.0}, "'tail.pos' is no motor"),
        ({"gripper.pos": 130.0}, "gripper.pos is 130, expected 0 .. 100"),
    ],
)
def test_values_that_fit_no_motor_are_refused_by_name(change: dict[str, float], words: str) -> None:
    motors = motors_of(so101_profile())
    with pytest.raises(InvalidInputError, match=words):
        motors.positions(dict.fromkeys(motors.keys, 0.0) | change)


def test_a_lacking_value_and_one_that_is_no_number_are_refused_by_name() -> None:
    motors = motors_of(so101_profile())
    whole = dict.fromkeys(motors.keys, 0.0)
    with pytest.raises(InvalidInputError, match=r"'elbow_flex.pos' is missing"):
        motors.positions({k: v for k, v in whole.items() if k != "elbow_flex.pos"})
    with pytest.raises(UnsafeError, match=r"wrist_roll.pos is nan"):
        motors.positions(whole | {"wrist_roll.pos": math.nan})
    with pytest.raises(UnsafeError, match="inf"):
        motors.measured(whole | {"wrist_roll.pos": math.inf})


def test_two_motors_of_one_joint_and_a_scale_of_nought_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="is repeated"):
        MotorMap([degrees("a", "j"), degrees("b", "j")])
    with pytest.raises(InvalidInputError, match="no finite scale"):
        MotorMap([percent("a", "j", 0.3, 0.3)])


@pytest.mark.parametrize("gripper", [{}, {"grip": np.nan}, {"grip": np.inf}])
def test_a_gripper_that_is_not_measured_is_not_ready(gripper: dict[str, float]) -> None:
    motors = MotorMap((degrees("a", "arm"), percent("g", "grip", 0.0, 0.04)))
    with pytest.raises(NotReadyError, match="grip"):
        motors.measured_values({"arm": 0.1, **gripper})
    told = motors.measured_values({"arm": 0.0, "grip": 0.02})
    assert told == {"a.pos": 0.0, "g.pos": 50.0}
