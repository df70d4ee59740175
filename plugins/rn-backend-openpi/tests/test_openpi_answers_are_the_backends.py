"""The client receives the backend's answers: bit-identical in each of the five spaces, within
rounding for the public profiles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from openpi_clients import ask, loaded, open_client

from rn_backend_openpi.case import REFLEX, Reflex, ReflexOptions, serving
from rn_backend_openpi.messages import RESERVED, from_observation
from rn_backend_openpi.options import PolicyOptions
from roboneuron import (
    EE_DELTA,
    ArmProfile,
    ArmState,
    ControlSpace,
    Frame,
    GripperProfile,
    JointSample,
    Observation,
    Pose,
    RobotProfile,
    UngroundedError,
    robot_space,
)

Observe = Callable[..., Observation]
ARM = tuple(f"joint{i}" for i in range(1, 8))
PAIR = tuple(f"{arm}{i}" for arm in ("left", "right") for i in range(6))


GRIP = GripperProfile(joint="finger", closed_position=0.0, open_position=0.08)
ONE = RobotProfile(name="one", arm_joints=ARM, gripper=GRIP)
SIX = replace(ONE, arm_joints=ARM[:6])
TWO = RobotProfile(
    name="two",
    arm_joints=PAIR,
    arms=tuple(
        ArmProfile(name=arm, joints=joints, base_link="b", tcp_link="t", gripper=GRIP)
        for arm, joints in (("left", PAIR[:6]), ("right", PAIR[6:]))
    ),
)
SPACES: dict[str, ControlSpace] = {
    "ee_delta": EE_DELTA,
    "ee_pose": robot_space("ee_pose", ONE, 10.0),
    "ee_pose of two arms": robot_space("ee_pose", TWO, 10.0),
    "joint_position": robot_space("joint_position", TWO, 50.0),
    "joint_velocity": robot_space("joint_velocity", ONE, 15.0),
    "joint_delta": replace(robot_space("joint_position", ONE, 20.0), kind="joint_delta"),
}


def _seen(observe: Observe, names: tuple[str, ...] = ARM) -> Observation:
    pose = Pose(position_m=np.array([0.4, 0.1, 0.2]), quaternion_xyzw=np.array([1.0, 0, 0, 0]))
    rng = np.random.default_rng(5)
    image = rng.integers(0, 256, (90, 160, 3), dtype=np.uint8)
    return replace(
        observe(),
        frames={"primary": Frame(camera="c", image=image, stamp_ns=1, frame_id="c")},
        joints=JointSample(names=names, position=rng.standard_normal(len(names))),
        arms={name: ArmState(ee_pose=pose, gripper_open=0.3) for name in ("left", "right")},
    )


@pytest.mark.parametrize("name", SPACES)
def test_rows_of_every_space_are_those_of_the_backend_to_the_bit(
    name: str, observe: Observe
) -> None:
    space = SPACES[name]
    model = Reflex(ReflexOptions(step_s=1.0 / (space.rate_hz or 8.0)), space=space)
    seen = _seen(observe)
    request = from_observation(seen)
    del request[RESERVED]
    with serving(model, space=space) as url:
        with loaded(PolicyOptions(url=url, timeout_s=20.0, coding="raw")) as backend:
            chunk = backend.predict(seen)
        with open_client(url) as plain:  # that knows only openpi's entries
            told = ask(plain, request)
    local = model.predict(seen)
    assert chunk.actions.tobytes() == told["actions"].tobytes() == local.actions.tobytes()
    assert (chunk.space, chunk.step_s) == (space, local.step_s)
    assert chunk.metrics["shared.model_ms"] >= 0.0


PUBLIC: dict[str, tuple[ControlSpace, tuple[str, ...]]] = {
    "libero": (EE_DELTA, ()),
    "bridge": (EE_DELTA, ()),
    "droid": (robot_space("joint_velocity", ONE, 15.0), ARM),
    "droid-position": (robot_space("joint_position", ONE, 15.0), ARM),
    "roboarena": (robot_space("joint_position", ONE, 15.0), ARM),
    "franka": (robot_space("joint_position", ONE, 20.0), ARM),
    "ur5e": (robot_space("joint_position", SIX, 20.0), ARM[:6]),
    "aloha": (robot_space("joint_position", TWO, 50.0), PAIR),
}
STEPS = {"libero": 0.05, "bridge": 0.2}


@pytest.mark.parametrize("profile", PUBLIC)
def test_rows_behind_a_public_profile_are_those_of_the_backend(
    profile: str, observe: Observe
) -> None:
    space, joints = PUBLIC[profile]
    keys = {"primary": "images.top"}
    options = {"profile": profile, "image_keys": keys, "image_size_px": "raw"}
    if joints:
        options["joints"] = joints
    own = ReflexOptions(step_s=STEPS.get(profile) or 1.0 / space.rate_hz, sees_hand=False)
    model = Reflex(own, space=space)
    seen = _seen(observe, joints or ARM)
    if not joints:
        seen = replace(seen, joints=None)
    with (
        serving(model, interface=options, space=space) as url,
        loaded(PolicyOptions(url=url, timeout_s=20.0, **options)) as backend,
    ):
        chunk = backend.predict(seen)
    local = model.predict(seen).actions
    # scales and openings are multiplied once in each direction
    np.testing.assert_allclose(chunk.actions, local, atol=1e-14, rtol=0)
    assert chunk.space == space


def test_a_camera_that_the_backend_needs_is_asked_for(observe: Observe) -> None:
    spec = replace(REFLEX, cameras=("primary", "wrist"), optional_cameras=())
    with (
        serving(Reflex(), spec) as url,
        loaded(PolicyOptions(url=url)) as backend,
        pytest.raises(UngroundedError, match="'wrist'"),
    ):
        backend.predict(_seen(observe))
