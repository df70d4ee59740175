"""The controller "urdf" for two arms: each solved on its own, one command for both, one collision
model.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from roboneuron.contract import (
    Action,
    ArmProfile,
    CollisionProfile,
    GripperProfile,
    Hold,
    JointCommand,
    JointLimits,
    JointSample,
    RobotProfile,
    SeveralArms,
    robot_space,
)

BAR = (
    '<collision><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.04 0.04"/></geometry>'
    "</collision>"
)
FACING_M = 1.2
NAMES = tuple(f"{arm}_q{i}" for arm in ("left", "right") for i in (1, 2, 3))
HOME = (0.0, 0.6, 0.6, 0.0, 0.6, 0.6)


def _urdf(arm: str, mount: str) -> str:
    """Three bars of 0.3 m that turn about z, on a mount."""
    links = "".join(f'<link name="{arm}_bar{i}">{BAR}</link>' for i in (1, 2, 3))
    parents = (f"{arm}_base", f"{arm}_bar1", f"{arm}_bar2")
    joints = "".join(
        f'<joint name="{arm}_q{i}" type="revolute"><parent link="{parent}"/>'
        f'<child link="{arm}_bar{i}"/><origin xyz="{0.3 if i > 1 else 0} 0 0"/><axis xyz="0 0 1"/>'
        '<limit lower="-3" upper="3" velocity="2" effort="9"/></joint>'
        for i, parent in enumerate(parents, start=1)
    )
    return (
        f'<link name="{arm}_base"/><link name="{arm}_tcp"/>{links}{joints}'
        f'<joint name="{arm}_mount" type="fixed"><parent link="table"/><child link="{arm}_base"/>'
        f'<origin {mount}/></joint><joint name="{arm}_tip" type="fixed">'
        f'<parent link="{arm}_bar3"/><child link="{arm}_tcp"/><origin xyz="0.3 0 0"/></joint>'
    )


def _arm(name: str) -> ArmProfile:
    return ArmProfile(
        name=name,
        joints=tuple(f"{name}_q{i}" for i in (1, 2, 3)),
        base_link=f"{name}_base",
        tcp_link=f"{name}_tcp",
        gripper=GripperProfile(joint=f"{name}_finger", closed_position=0.0, open_position=0.04),
    )


def pair(collision: CollisionProfile | None = None) -> RobotProfile:
    """Two of them at one table, facing each other."""
    arms = (_arm("left"), _arm("right"))
    facing = f'xyz="{FACING_M} 0 0" rpy="0 0 {math.pi}"'
    text = f'<link name="table"/>{_urdf("left", "")}{_urdf("right", facing)}'
    return RobotProfile(
        name="pair",
        urdf=f'<robot name="pair">{text}</robot>',
        base_link="table",
        tcp_link="left_tcp",
        arm_joints=NAMES,
        limits=JointLimits(
            lower=np.full(6, -3.0),
            upper=np.full(6, 3.0),
            velocity=np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0]),
            acceleration=np.full(6, 10.0),
            effort=np.full(6, 9.0),
        ),
        home_rad=np.array(HOME),
        gripper=arms[0].gripper,
        arms=arms,
        collision=collision,
    )


def loaded(profile: RobotProfile) -> UrdfController:
    controller = UrdfController(None, profile)
    controller.load()
    return controller


def sample(*position: float) -> JointSample:
    return JointSample(names=NAMES, position=np.array(position or HOME), stamp_ns=5)


def execute(kind: str, row: list[float], step_s: float = 0.1) -> JointCommand | Hold:
    profile = pair()
    space = robot_space(kind, profile)
    return loaded(profile).execute(space, space.check(row), sample(), step_s)


def test_poses_of_both_arms_are_in_the_one_base_frame() -> None:
    controller = loaded(pair())
    assert isinstance(controller, SeveralArms)
    left, right = controller.poses(sample())
    assert controller.forward(sample()).position_m.tolist() == left.position_m.tolist()
    np.testing.assert_allclose(
        right.position_m, [FACING_M - left.position_m[0], -left.position_m[1], 0.0], atol=1e-12
    )


def test_a_posture_tells_both_arms() -> None:
    posture = loaded(pair()).inspect(sample(0.0, 0.6, 0.6, 0.0, 0.0, 0.0))
    left, right = posture.arms
    assert left.smallest_singular_value is not None
    assert right.smallest_singular_value is not None
    np.testing.assert_allclose(right.pose.position_m, [FACING_M - 0.9, 0.0, 0.0], atol=1e-12)
    assert posture.near is None


def test_joint_positions_become_one_command_in_the_time_of_the_slower_arm() -> None:
    row = [0.1, 0.6, 0.6, 1.0, 0.18, 0.6, 0.6, 0.25]
    command = execute("joint_position", row)
    assert isinstance(command, JointCommand)
    assert command.names == (*NAMES[:3], "left_finger", *NAMES[3:], "right_finger")
    np.testing.assert_allclose(
        command.position, [0.1, 0.6, 0.6, 0.04, 0.18, 0.6, 0.6, 0.01], atol=1e-12
    )
    # the right arm may use 0.9 of 1 rad/s
    assert command.duration_s == pytest.approx(0.18 / 0.9)


def test_joint_velocities_add_to_the_joints_of_their_own_arm() -> None:
    command = execute("joint_velocity", [0.5, 0, 0, 1.0, 0, 0, -0.5, 1.0])
    assert isinstance(command, JointCommand)
    np.testing.assert_allclose(
        command.position[[0, 1, 2, 4, 5, 6]], [0.05, 0.6, 0.6, 0.0, 0.6, 0.55], atol=1e-12
    )


def _row(profile: RobotProfile, *moves_m: tuple[float, float]) -> list[float]:
    row: list[float] = []
    for pose, (dx, dy) in zip(loaded(profile).poses(sample()), moves_m, strict=True):
        row += [*(pose.position_m + np.array([dx, dy, 0.0])), *pose.quaternion_xyzw, 1.0]
    return row


def test_poses_are_reached_by_each_arm() -> None:
    profile = pair()
    wanted = _row(profile, (-0.01, 0.005), (0.01, 0.005))
    command = execute("ee_pose", wanted)
    assert isinstance(command, JointCommand)
    reached = loaded(profile).poses(
        JointSample(names=command.names, position=command.position, stamp_ns=0)
    )
    np.testing.assert_allclose(reached[0].position_m, wanted[:3], atol=1e-4)
    np.testing.assert_allclose(reached[1].position_m, wanted[8:11], atol=1e-4)


def test_a_refusal_of_one_arm_names_it_and_moves_none() -> None:
    answer = execute("ee_pose", _row(pair(), (0.0, 0.0), (0.5, 0.0)))
    assert isinstance(answer, Hold)
    assert answer.code == "action_too_large"
    assert answer.reason.startswith("right: ")


def test_the_7_vector_is_refused() -> None:
    action = Action(translation_m=np.zeros(3), rotation_rad=np.zeros(3), gripper_open=1.0)
    answer = loaded(pair()).compute(action, sample(), 0.1)
    assert isinstance(answer, Hold)
    assert answer.code == "bad_action"


def test_links_of_both_arms_are_compared() -> None:
    """Stretched towards each other they are 1.2 - 0.9 - 0.9 m apart, that is, they overlap."""
    controller = loaded(pair(CollisionProfile(min_distance_m=0.01)))
    near = controller.inspect(sample(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)).near
    assert near
    assert ("left_bar3", "right_bar3") in {(pair.first, pair.second) for pair in near}
    assert controller.inspect(sample()).near == ()


def test_the_first_links_of_two_arms_are_no_fingers_of_one_hand() -> None:
    """Both first joints hang on what does not move, as two fingers hang on one hand."""
    profile = pair(CollisionProfile(min_distance_m=0.7))
    near = loaded(profile).inspect(sample(0.0, 1.5, 1.5, 0.0, 1.5, 1.5)).near
    assert near
    assert ("left_bar1", "right_bar1") in {(pair.first, pair.second) for pair in near}
