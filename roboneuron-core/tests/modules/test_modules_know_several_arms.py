"""Control refuses 7-vectors for several arms, and inference sees the state of each."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image

from roboneuron.contract import (
    ArmProfile,
    CameraProfile,
    Controller,
    GripperProfile,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    RobotProfile,
)
from roboneuron.errors import ConfigurationError
from roboneuron.modules.control.module import _executed_spaces
from roboneuron.modules.inference.inputs import NewestInputs
from roboneuron.plugins.specs import ControllerSpec
from roboneuron.ros.messages import to_joint_state, to_pose_stamped

NAMES = ("left_a", "right_a")
ARMS = tuple(
    ArmProfile(
        name=name,
        joints=(f"{name}_a",),
        base_link="base",
        tcp_link=f"{name}_tcp",
        gripper=GripperProfile(joint=f"{name}_finger", closed_position=0.0, open_position=0.04),
    )
    for name in ("left", "right")
)
PAIR = RobotProfile(name="pair", arm_joints=NAMES, arms=ARMS, gripper=ARMS[0].gripper)
EVERY = ControllerSpec(
    name="every",
    summary="Every space.",
    target="every:Controller",
    spaces=("ee_delta", "ee_pose", "joint_position", "joint_delta"),
)


class OneArm:
    """Executes rows, and returns the TCP of one arm."""

    def execute(self, *arguments: object) -> JointCommand | Hold:
        raise NotImplementedError


class BothArms(OneArm):
    """Returns the TCP of both arms."""

    def poses(self, joints: JointSample) -> tuple[Pose, ...]:
        raise NotImplementedError


def test_control_of_several_arms_executes_what_names_them() -> None:
    spaces = _executed_spaces(EVERY, cast("Controller", BothArms()), PAIR)
    assert [label.partition(":")[0] for label in spaces] == ["ee_pose", "joint_position"]
    assert all("left/gripper_open" in label for label in spaces)


@pytest.mark.parametrize(
    ("spec", "controller"),
    [
        (EVERY, OneArm()),
        (ControllerSpec(name="delta", summary="Deltas.", target="delta:Controller"), BothArms()),
    ],
)
def test_a_controller_for_one_arm_is_refused(spec: ControllerSpec, controller: object) -> None:
    with pytest.raises(ConfigurationError, match="moves one arm; robot 'pair' has 2"):
        _executed_spaces(spec, cast("Controller", controller), PAIR)


def _inputs() -> NewestInputs:
    camera = CameraProfile(name="front", role="primary", frame_id="front", width=2, height=1)
    return NewestInputs(
        cameras={"primary": camera},
        optional=frozenset(),
        needs_state=True,
        gripper=PAIR.gripper,
        arms=ARMS,
        max_age_s=5.0,
        status=cast("Any", SimpleNamespace(dropped=set())),
        now_ns=time.time_ns,
        take_images=time.sleep,
    )


def _pose(x_m: float) -> PoseStamped:
    position, quaternion = np.array([x_m, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
    pose = Pose(position_m=position, quaternion_xyzw=quaternion, stamp_ns=time.time_ns())
    return to_pose_stamped(pose, "base")


def _image() -> Image:
    image = Image(height=1, width=2, encoding="rgb8", step=6, data=bytes(6))
    image.header.frame_id = "front"
    image.header.stamp.sec, image.header.stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
    return image


def _measure(inputs: NewestInputs) -> None:
    names = (*NAMES, "left_finger", "right_finger")
    position = np.array([0.0, 0.0, 0.01, 0.03])
    joints = JointSample(names=names, position=position, stamp_ns=time.time_ns())
    inputs.on_joint_state(to_joint_state(joints))
    inputs.on_ee_pose(_pose(0.1))
    inputs.on_image("primary", _image())


def test_an_observation_waits_for_the_pose_of_every_arm() -> None:
    inputs = _inputs()
    _measure(inputs)
    inputs.on_arm_pose("left", _pose(0.1))
    assert inputs.wait(0.01) is None


def test_an_observation_holds_pose_and_opening_of_each_arm() -> None:
    inputs = _inputs()
    inputs.on_arm_pose("left", _pose(0.1))
    inputs.on_arm_pose("right", _pose(0.9))
    _measure(inputs)
    observation = inputs.wait(1.0)
    assert observation is not None
    assert {name: float(arm.ee_pose.position_m[0]) for name, arm in observation.arms.items()} == {
        "left": 0.1,
        "right": 0.9,
    }
    assert {name: arm.gripper_open for name, arm in observation.arms.items()} == {
        "left": pytest.approx(0.25),
        "right": pytest.approx(0.75),
    }
    assert observation.gripper_open == pytest.approx(0.25)
