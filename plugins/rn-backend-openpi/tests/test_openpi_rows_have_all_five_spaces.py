"""Rows of every space, in every convention: conversion to the contract and back; and the state with
them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.interface_options import InterfaceOptions
from rn_backend_openpi.rows import PoseRows, Rows
from rn_backend_openpi.space import policy_space
from rn_robot_fr3.profile import profile as fr3_profile
from roboneuron import (
    ArmState,
    ConfigurationError,
    Frame,
    InvalidInputError,
    JointSample,
    Observation,
    Pose,
    UngroundedError,
    UnsafeError,
)

ARM = ("a1", "a2", "a3", "b1", "b2", "b3")
TWO = {"joints": ARM, "arms": ("left", "right")}
STATE = {"state_keys": {"state": ["joints", "gripper_open"]}}
ROUNDING = 1e-12
"""A few products and sums of numbers of order 1; a wrong convention causes errors of 0.01 and
more.
"""
GRIPPERS = ("open_fraction", "closed_fraction", "signed_open", "signed_close")
ROTATIONS = ("quaternion", "quaternion_wxyz", "rotvec", "rpy", "rot6d", "rot6d_rows")
QUARTER = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
"""A quarter turn about z."""


def _rows(**options: Any) -> Rows:
    return layout_of(InterfaceOptions(**options)).rows


def _own(action: dict[str, Any], **options: Any) -> Rows:
    state = STATE if "joints" in options else {"state_keys": {"state": ["position", "quaternion"]}}
    return _rows(profile="own", action=action, **{**state, **options})


def _pose(position: tuple[float, float, float] = (0.4, 0.1, 0.3)) -> Pose:
    return Pose(position_m=np.array(position), quaternion_xyzw=QUARTER)


def _seen(**changes: Any) -> Observation:
    grey = np.full((32, 48, 3), 90, dtype=np.uint8)
    values = {
        "frames": {"primary": Frame(camera="c", image=grey, stamp_ns=0, frame_id="c")},
        "instruction": "go",
        "joints": JointSample(names=ARM[::-1], position=np.arange(6.0)[::-1] / 10),
        "ee_pose": _pose(),
        "gripper_open": 0.25,
    }
    return Observation(**{**values, **changes})


@pytest.mark.parametrize("kind", ["joint_position", "joint_velocity", "joint_delta"])
@pytest.mark.parametrize("gripper", GRIPPERS)
def test_rows_of_joints_come_back(kind: str, gripper: str) -> None:
    action = {"kind": kind, "gripper": gripper, "rate_hz": 20, "scale": 0.5}
    rows = _own(action, **TWO)
    assert rows.space.kind == kind
    assert rows.space.keys[3] == "left/gripper_open"
    assert rows.space.keys[4] == "right/b1"
    units = {channel.unit for channel in rows.space.channels}
    assert units == {"opening", "rad/s" if kind == "joint_velocity" else "rad"}
    assert rows.step_s == 0.05
    contract = np.random.default_rng(0).uniform(0.0, 1.0, (5, 8))
    served = rows.from_contract(contract, _seen())
    np.testing.assert_allclose(served[:, 0], contract[:, 0] * 2.0, atol=ROUNDING)
    np.testing.assert_allclose(rows.to_contract(served, _seen()), contract, atol=ROUNDING)


@pytest.mark.parametrize(
    ("gripper", "closed", "opened"),
    [
        ("open_fraction", 0.0, 1.0),
        ("closed_fraction", 1.0, 0.0),
        ("signed_open", -1.0, 1.0),
        ("signed_close", 1.0, -1.0),
    ],
)
def test_each_gripper_convention_says_what_its_name_says(
    gripper: str, closed: float, opened: float
) -> None:
    action = {"kind": "joint_position", "gripper": gripper, "rate_hz": 20}
    rows = _own(action, joints=("a",))
    served = np.array([[0.0, closed], [0.0, opened], [0.0, opened + 3 * (opened - closed)]])
    assert rows.to_contract(served, _seen())[:, 1].tolist() == [0.0, 1.0, 1.0]


def test_a_policy_without_a_gripper_has_no_such_channel() -> None:
    rows = _own({"kind": "joint_delta", "gripper": "none", "rate_hz": 20}, joints=("a", "b"))
    assert (rows.space.keys, rows.width) == (("a", "b"), 2)
    poses = _own({"kind": "ee_pose", "gripper": "none", "rate_hz": 5, "rotation": "rpy"})
    assert (poses.space.size, poses.width) == (7, 6)


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(ROTATIONS),
    st.sampled_from(GRIPPERS),
    st.integers(0, 2**32 - 1),
)
def test_poses_come_back_in_every_rotation(rotation: str, gripper: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    action = {"kind": "ee_pose", "rotation": rotation, "gripper": gripper, "rate_hz": 10}
    rows = _own(action, arms=("left", "right"), base_position_m=(0.1, -0.2, 0.3))
    assert isinstance(rows, PoseRows)
    assert rows.space.keys[8] == "right/x"
    quaternions = rng.standard_normal((4, 2, 4))
    quaternions /= np.linalg.norm(quaternions, axis=2, keepdims=True)
    parts = [
        np.hstack([rng.uniform(-1, 1, (4, 3)), quaternions[:, arm], rng.uniform(0, 1, (4, 1))])
        for arm in range(2)
    ]
    contract = np.hstack(parts)
    again = rows.to_contract(rows.from_contract(contract, _seen()), _seen())
    for arm in range(2):
        at = slice(8 * arm + 3, 8 * arm + 7)
        turns = np.abs(np.sum(contract[:, at] * again[:, at], axis=1))
        np.testing.assert_allclose(turns, 1.0, atol=1e-9)  # q and -q are one rotation
    others = [0, 1, 2, 7, 8, 9, 10, 15]
    np.testing.assert_allclose(again[:, others], contract[:, others], atol=ROUNDING)


@pytest.mark.parametrize(
    ("rotation", "values"),
    [
        ("quaternion", [0, 0, np.sqrt(0.5), np.sqrt(0.5)]),
        ("quaternion_wxyz", [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]),
        ("rotvec", [0, 0, np.pi / 2]),
        ("rpy", [0, 0, np.pi / 2]),
        ("rot6d", [0, 1, 0, -1, 0, 0]),
        ("rot6d", [0, 2, 0, -3, 0.5, 0]),
        ("rot6d_rows", [0, -1, 0, 1, 0, 0]),
    ],
)
def test_a_quarter_turn_is_one_in_every_rotation(rotation: str, values: list[float]) -> None:
    rows = _own({"kind": "ee_pose", "rotation": rotation, "gripper": "none", "rate_hz": 10})
    out = rows.to_contract(np.array([[0.1, 0.2, 0.3, *values]]), _seen())
    np.testing.assert_allclose(out[0], [0.1, 0.2, 0.3, *QUARTER], atol=ROUNDING)


@pytest.mark.parametrize("values", [[0.0] * 6, [1.0, 0, 0, 2.0, 0, 0]])
def test_values_that_are_no_rotation_are_unsafe(values: list[float]) -> None:
    rows = _own({"kind": "ee_pose", "rotation": "rot6d", "gripper": "none", "rate_hz": 10})
    with pytest.raises(UnsafeError, match="no rotation"):
        rows.to_contract(np.array([[0.0, 0, 0, *values]]), _seen())


SEVEN = tuple(f"joint{i}" for i in range(1, 8))
POSTURE = np.linspace(-0.6, 0.6, 7)
TWELVE = tuple(f"{arm}{i}" for arm in ("left", "right") for i in range(6))
TERMS: dict[str, tuple[tuple[str, ...], dict[str, list[float]], list[float], list[float]]] = {
    "libero": (
        (),
        {"observation/state": [0.4, 0.1, 0.3, *np.array([1, 1, 0]) * np.pi / 2**0.5, 0.01, -0.01]},
        [1.0, 0, 0, 0, 0, 0.5, -1.0],
        [0.05, 0, 0, 0, 0, 0.25, 1.0],
    ),
    # 1 is 3 rad/s and the maximum; in DROID 1 is closed
    "droid": (
        SEVEN,
        {"observation/joint_position": [*POSTURE], "observation/gripper_position": [0.75]},
        [0.1, -0.2, 0, 0, 0, 0, 4.0, 0.25],
        [0.3, -0.6, 0, 0, 0, 0, 3.0, 0.75],
    ),
    "franka": (
        SEVEN,
        {"observation/state": [*POSTURE, 0.75]},
        [*POSTURE, 1.0],
        [*POSTURE, 0.0],
    ),
    "aloha": (
        TWELVE,
        {"state": [*range(6), 0.2, *range(6, 12), 0.9]},
        [*[0.1] * 6, 0.25, *[-0.1] * 6, 1.5],
        [*[0.1] * 6, 0.25, *[-0.1] * 6, 1.0],
    ),
}
"""By profile: joints, state of a request, a served row, and that row in the contract."""


@pytest.mark.parametrize("profile", TERMS)
def test_a_policy_is_asked_and_answers_in_its_own_terms(profile: str) -> None:
    joints, state, served, row = TERMS[profile]
    given = {"joints": joints} if joints else {}
    layout = layout_of(InterfaceOptions(profile=profile, **given))
    position = np.arange(12.0) if joints == TWELVE else POSTURE
    names, grey = joints or SEVEN, np.full((112, 224, 3), 200, dtype=np.uint8)
    frame = Frame(camera="c", image=grey, stamp_ns=0, frame_id="c")
    down = Pose(position_m=np.array([0.4, 0.1, 0.3]), quaternion_xyzw=QUARTER[[2, 3, 0, 1]])
    seen = _seen(
        frames=dict.fromkeys(("primary", "wrist", "right_wrist"), frame),
        joints=JointSample(names=names[::-1], position=position[::-1]),
        ee_pose=down,
        arms={"left": ArmState(ee_pose=down, gripper_open=0.2)}
        | {"right": ArmState(ee_pose=down, gripper_open=0.9)},
    )
    request = layout.request_of(seen)
    for key, values in state.items():
        np.testing.assert_allclose(request[key], values, atol=ROUNDING)
    images = request["images"] if profile == "aloha" else request
    image = images[layout.image_keys["primary"].rpartition(".")[2]]
    upright = image.transpose(1, 2, 0) if profile == "aloha" else image
    assert (upright.dtype, upright.shape) == (np.uint8, (224, 224, 3))
    assert (upright[0, 0, 0], upright[112, 112, 0]) == (0, 200), "black bars above and below"
    rows = layout.rows_of(np.array([served]), seen)
    np.testing.assert_allclose(rows, [row], atol=ROUNDING)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"profile": "libero", "joints": SEVEN}, "'joints' has no effect"),
        ({"profile": "droid"}, "needs the option 'joints'"),
        ({"profile": "droid", "joints": SEVEN[:6]}, "names 6 joints, profile 'droid' has 7"),
        ({"profile": "droid", "joints": (*SEVEN[:6], SEVEN[0])}, "each joint appears once"),
    ],
)
def test_joints_that_do_not_fit_are_refused(options: dict[str, Any], word: str) -> None:
    with pytest.raises(ConfigurationError, match=word):
        layout_of(InterfaceOptions(**options))


def test_a_missing_camera_or_joint_is_named() -> None:
    layout = layout_of(InterfaceOptions(profile="franka", joints=SEVEN))
    with pytest.raises(UngroundedError, match="joint1"):
        layout.request_of(_seen())
    measured = JointSample(names=SEVEN, position=POSTURE)
    with pytest.raises(UngroundedError, match="camera role 'wrist'"):
        layout.request_of(_seen(joints=measured))


def test_a_space_that_does_not_fit_the_robot_names_its_joints() -> None:
    given = {"url": "ws://gpu", "profile": "own", **STATE, **TWO, **_joint_action()}
    with pytest.raises(ConfigurationError, match=r"names a1, .*does not have") as caught:
        policy_space(given, fr3_profile())
    assert '"fr3_joint1"' in caught.value.hint
    with pytest.raises(ConfigurationError, match="for 2 arm"):
        _own(
            {"kind": "ee_pose", "rotation": "rpy", "gripper": "none", "rate_hz": 1},
            joints=ARM[:5],
            arms=("left", "right"),
        )


def _joint_action() -> dict[str, Any]:
    return {"action": {"kind": "joint_position", "gripper": "open_fraction", "rate_hz": 10}}


def _again(options: dict[str, Any], seen: Observation) -> Observation:
    layout = layout_of(InterfaceOptions(**options))
    request = layout.request_of(seen)
    return layout.observation_of(request, needed=("primary",), has_state=True)


@pytest.mark.parametrize(
    "options",
    [
        {"profile": "libero"},
        {"profile": "bridge"},
        {"profile": "ur5e", "joints": ARM},
        {
            "profile": "own",
            **_joint_action(),
            "joints": ARM,
            "state_keys": {"s": ["joints", "rpy", "gripper_closed"], "p": ["position"]},
        },
        {
            "profile": "own",
            **_joint_action(),
            "joints": ARM,
            "state_keys": {
                "state.a": ["quaternion"],
                "state.b": ["padding", "position", "fingers"],
            },
            "base_position_m": (0.1, 0.2, 0.3),
        },
    ],
)
def test_states_of_terms_come_back(options: dict[str, Any]) -> None:
    images = {"image_keys": {"primary": "images.top"}, "image_axes": "chw", "image_size_px": "raw"}
    got, seen = _again({**options, **images, "image_flip": "rotate-180"}, _seen()), _seen()
    assert got.frames["primary"].image.tobytes() == seen.frames["primary"].image.tobytes()
    assert got.gripper_open == pytest.approx(0.25, abs=ROUNDING)
    if options["profile"] != "ur5e":
        assert got.ee_pose is not None
        assert seen.ee_pose is not None
        np.testing.assert_allclose(got.ee_pose.position_m, seen.ee_pose.position_m, atol=ROUNDING)
        turn = abs(got.ee_pose.quaternion_xyzw @ QUARTER)
        assert turn == pytest.approx(1.0, abs=ROUNDING)
    if "joints" in options and "state.a" not in options.get("state_keys", {}):
        assert got.joints is not None
        assert dict(zip(got.joints.names, got.joints.position.tolist(), strict=True)) == {
            name: i / 10 for i, name in enumerate(ARM)
        }


def test_states_of_two_arms_come_back_without_poses_nobody_told() -> None:
    names = tuple(f"{arm}{i}" for arm in ("left", "right") for i in range(6))
    arms = {
        "left": ArmState(ee_pose=_pose(), gripper_open=0.2),
        "right": ArmState(ee_pose=_pose(), gripper_open=0.9),
    }
    seen = _seen(joints=JointSample(names=names, position=np.arange(12.0)), arms=arms)
    options = {"profile": "aloha", "joints": names, "image_keys": {"primary": "images.cam_high"}}
    got = _again(options, seen)
    assert got.joints is not None
    assert got.joints.names == names
    assert {name: arm.gripper_open for name, arm in got.arms.items()} == {"left": 0.2, "right": 0.9}
    assert np.isnan(got.arms["right"].ee_pose.position_m).all()
    with pytest.raises(UngroundedError, match="arm 'left'"):
        layout_of(InterfaceOptions(**options)).request_of(_seen())


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"prompt": 5}, "no text at 'prompt'"),
        ({"prompt": " "}, "no text at 'prompt'"),
        ({"observation/image": None}, "image 'observation/image' .* is missing"),
        ({"observation/image": np.zeros((4, 4, 3))}, "no uint8 array"),
        ({"observation/image": np.zeros((4, 4), np.uint8)}, "no uint8 array"),
        ({"observation/image": np.zeros((4, 4, 4), np.uint8)}, "uint8"),
        ({"observation/state": None}, "'observation/state' is missing"),
        ({"observation/state": "x"}, "is a str"),
        ({"observation/state": np.zeros(9)}, r"shape \(9,\), expected \(8,\)"),
        ({"observation/state": np.zeros((1, 8))}, "shape"),
    ],
)
def test_a_request_that_lacks_something_is_told_what(change: dict[str, Any], word: str) -> None:
    layout = layout_of(
        InterfaceOptions(profile="libero", image_keys={"primary": "observation/image"})
    )
    request = {**layout.request_of(_seen()), **change}
    with pytest.raises(InvalidInputError, match=word):
        layout.observation_of(request, needed=("primary",), has_state=True)
