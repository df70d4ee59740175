"""Conversion of a policy's numbers to those of the robot, and back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_folders import ARM, DATA
from pydantic import ValidationError

from rn_backend_lerobot.channels import Columns, Meaning
from rn_backend_lerobot.options import ChannelOptions, LeRobotOptions
from rn_backend_lerobot.wiring import wire
from roboneuron import (
    ArmState,
    ConfigurationError,
    Frame,
    JointSample,
    Observation,
    Pose,
    UngroundedError,
)

Make = Callable[..., Path]


@pytest.mark.parametrize(
    ("given", "number", "robot"),
    [
        ({"unit": "radians"}, 0.5, 0.5),
        ({"unit": "degrees"}, 90.0, math.pi / 2),
        ({"unit": "degrees", "sign": -1}, 90.0, -math.pi / 2),
        ({"unit": "degrees", "sign": -1, "offset": 30.0}, 90.0, -math.pi / 3),
        ({"unit": "millimetres"}, 250.0, 0.25),
        ({"unit": "metres", "scale": 0.05}, -1.0, -0.05),
        ({"unit": "range_m100_100", "low": -1.0, "high": 3.0}, 0.0, 1.0),
        ({"unit": "range_m100_100", "low": 1.5, "high": -1.5}, 100.0, -1.5),
        ({"unit": "range_0_100", "low": 0.2, "high": 1.2}, 25.0, 0.45),
    ],
)
def test_each_unit_is_converted_both_ways(
    given: dict[str, Any], number: float, robot: float
) -> None:
    columns = Columns([ChannelOptions(to="joint", **given).meaning("pan.pos")])
    np.testing.assert_allclose(columns.to_contract(np.array([[number]])), [[robot]], atol=1e-12)
    seen = _seen(JointSample(names=("joint",), position=np.array([robot])))
    np.testing.assert_allclose(columns.read(seen), [number], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("unit", "number", "opening"),
    [
        ("open_fraction", 0.25, 0.25),
        ("closed_fraction", 0.25, 0.75),
        ("open_percent", 40.0, 0.4),
        ("closed_percent", 40.0, 0.6),
        ("open_percent", 130.0, 1.0),
        ("closed_fraction", 1.2, 0.0),
    ],
)
def test_grippers_become_openings_within_bounds(unit: Any, number: float, opening: float) -> None:
    columns = Columns([Meaning(name="gripper.pos", to="gripper_open", unit=unit)])
    np.testing.assert_allclose(columns.to_contract(np.array([[number]])), [[opening]])


def test_the_chunk_of_lerobot_becomes_the_chunk_of_the_contract(
    checkpoint: Make, options: dict[str, Any]
) -> None:
    """Numbers recorded in LeRobot's environment, with other units: the policy uses degrees."""
    recorded = np.load(DATA / "act-chunk.npz")
    folder = checkpoint()
    wiring = wire(LeRobotOptions.model_validate({**options, "checkpoint": folder}))
    actions = wiring.action.to_contract(recorded["rows"][: wiring.folder.rows])
    np.testing.assert_allclose(actions, recorded["actions"], atol=1e-12)
    # as LeRobot un-normalises: number * std + mean, in float32
    statistics = wiring.folder.directory / "policy_postprocessor_step_0_unnormalizer_processor"
    from rn_backend_lerobot.tensor_file import read_tensors

    known = read_tensors(statistics.with_suffix(".safetensors"))
    rows = recorded["normalized"] * known["action.std"] + known["action.mean"]
    np.testing.assert_allclose(recorded["rows"], rows, atol=1e-6)


def test_numbers_are_mapped_by_name_whatever_their_order(
    checkpoint: Make, options: dict[str, Any]
) -> None:
    names = [f"m{i}.pos" for i in range(7)] + ["gripper.pos"]
    channels = {f"m{i}.pos": {"to": ARM[6 - i], "unit": "degrees"} for i in range(7)}
    channels["gripper.pos"] = {"to": "gripper_open", "unit": "open_percent"}
    given = {"checkpoint": checkpoint(), "rate_hz": 30, "names": names, "channels": channels}
    wiring = wire(LeRobotOptions.model_validate(given))
    assert wiring.space.keys == (*ARM[::-1], "gripper_open")
    position = np.linspace(-0.6, 0.6, 7)
    seen = replace(_seen(JointSample(names=ARM, position=position)), gripper_open=0.3)
    read = wiring.state.read(seen)
    np.testing.assert_allclose(read, [*np.degrees(position[::-1]), 30.0], rtol=1e-6)


def test_names_in_the_checkpoint_are_taken_and_compared(checkpoint: Make) -> None:
    names = [f"m{i}" for i in range(8)]
    folder = checkpoint(config=lambda c: c.update(action_feature_names=names))
    targets = [*ARM, "gripper_open"]
    units = ["radians"] * 7 + ["open_fraction"]
    channels = {
        name: {"to": to, "unit": unit} for name, to, unit in zip(names, targets, units, strict=True)
    }
    given = {"checkpoint": folder, "rate_hz": 30, "channels": channels}
    assert wire(LeRobotOptions.model_validate(given)).space.keys == tuple(targets)
    other = {**given, "names": names[::-1]}
    with pytest.raises(ConfigurationError, match=r"the checkpoint says \['m0'"):
        wire(LeRobotOptions.model_validate(other))


def test_a_checkpoint_without_names_asks_for_them(checkpoint: Make) -> None:
    channels = {"m0": {"to": "a", "unit": "radians"}}
    given = {"checkpoint": checkpoint(), "rate_hz": 30, "channels": channels}
    with pytest.raises(ConfigurationError, match="does not name the 8 values") as refusal:
        wire(LeRobotOptions.model_validate(given))
    assert "meta/info.json" in refusal.value.hint


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"m3": None}, "Nothing is mapped to 'm3'"),
        ({"m3": {"to": ARM[0], "unit": "radians"}}, f"mapped to {ARM[0]}"),
        ({"m3": {"to": ARM[3], "unit": "open_percent"}}, "has the unit 'open_percent'"),
        ({"m7": {"to": "gripper_open", "unit": "degrees"}}, "counted in 'opening'"),
        ({"m9": {"to": "x", "unit": "metres"}}, "names m9, which the policy does not have"),
    ],
)
def test_a_number_without_its_meaning_is_refused(
    checkpoint: Make, change: dict[str, Any], message: str
) -> None:
    names = [f"m{i}" for i in range(8)]
    channels: dict[str, Any] = {f"m{i}": {"to": ARM[i], "unit": "radians"} for i in range(7)}
    channels["m7"] = {"to": "gripper_open", "unit": "open_fraction"}
    channels = {name: value for name, value in {**channels, **change}.items() if value}
    given = {"checkpoint": checkpoint(), "rate_hz": 30, "names": names, "channels": channels}
    with pytest.raises(ConfigurationError, match=message):
        wire(LeRobotOptions.model_validate(given))


@pytest.mark.parametrize(
    "given",
    [
        {"unit": "range_0_100"},
        {"unit": "degrees", "low": 0.0, "high": 1.0},
        {"unit": "range_0_100", "low": 1.0, "high": 1.0},
        {"unit": "range_0_100", "low": 0.0, "high": 1.0, "sign": -1},
        {"unit": "turns"},
    ],
)
def test_units_that_say_too_much_or_too_little_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        ChannelOptions(to="joint", **given)


def test_the_state_may_hold_the_pose_of_the_tcp() -> None:
    turn = Pose(
        position_m=np.array([0.1, 0.2, 0.3]),
        quaternion_xyzw=np.array([0.0, 0.0, math.sin(0.25), math.cos(0.25)]),
    )
    names = ("x", "z", "qw", "rz")
    units: list[Any] = ["metres", "millimetres", "unitless", "degrees"]
    columns = Columns([Meaning(name=n, to=n, unit=u) for n, u in zip(names, units, strict=True)])
    seen = replace(_seen(None), ee_pose=turn)
    expected = [0.1, 300.0, math.cos(0.25), math.degrees(0.5)]
    np.testing.assert_allclose(columns.read(seen), expected, rtol=1e-6)


def test_two_arms_are_read_by_their_names() -> None:
    poses = {
        name: ArmState(
            ee_pose=Pose(position_m=np.full(3, place), quaternion_xyzw=np.array([0.0, 0, 0, 1])),
            gripper_open=place,
        )
        for name, place in (("left", 0.2), ("right", 0.8))
    }
    seen = replace(_seen(None), arms=poses)
    both = [
        Meaning(name="a", to="right/gripper_open", unit="open_percent"),
        Meaning(name="b", to="left/x", unit="metres"),
    ]
    np.testing.assert_allclose(Columns(both).read(seen), [80.0, 0.2], rtol=1e-6)
    assert both[0].channel("joint_position").key == "right/gripper_open"


@pytest.mark.parametrize("to", ["joint", "gripper_open", "qx"])
def test_what_is_not_measured_is_named(to: str) -> None:
    columns = Columns([Meaning(name="n", to=to, unit="radians")])
    with pytest.raises(UngroundedError, match=f"no finite '{to}'"):
        columns.read(_seen(None))


def test_a_frame_is_found_by_role_or_by_the_cameras_name(
    checkpoint: Make, options: dict[str, Any]
) -> None:
    wiring = wire(LeRobotOptions.model_validate({**options, "checkpoint": checkpoint()}))
    front, wrist = wiring.images
    seen = _seen(None)
    assert wiring.frame(front, seen).camera == "front"
    assert wiring.frame(wrist, seen).camera == "wrist"
    renamed = replace(seen, frames={"primary": replace(seen.frames["primary"], camera="top")})
    with pytest.raises(UngroundedError, match=r"images\.front' needs the camera 'front'.*primary"):
        wiring.frame(front, renamed)


def _seen(joints: JointSample | None) -> Observation:
    image = np.zeros((96, 96, 3), dtype=np.uint8)
    frames = {
        role: Frame(camera=camera, image=image, stamp_ns=1, frame_id="optical")
        for role, camera in (("primary", "front"), ("wrist", "wrist"))
    }
    return Observation(frames=frames, instruction="go", joints=joints)
