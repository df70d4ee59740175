"""The controller "urdf" on four small arms: it reaches what it accepts and refuses the rest with a
reason.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rn_controller_urdf.controller import UrdfController
from rn_controller_urdf.options import UrdfControllerOptions
from rn_controller_urdf.refusals import HOLD_CODES
from rn_testing.robot_judge import random_chain
from roboneuron.contract import (
    Action,
    CollisionProfile,
    GripperProfile,
    Hold,
    JointCommand,
    JointLimits,
    JointSample,
    RobotProfile,
    Workspace,
    apply_delta,
)
from roboneuron.contract.rotation import matrix_from_quaternion, rotvec_from_matrix
from roboneuron.errors import ConfigurationError, StateError, UnsafeError

DATA = Path(__file__).parent / "data"
SEVEN = tuple(f"j{i}" for i in range(1, 8))
SEVEN_HOME = (0.0, 0.5, 0.0, 1.5, 0.0, -1.0, 0.0)
SIX = ("pan", "lift", "elbow", "wrist1", "wrist2", "wrist3")


def robot(name: str, base: str, tcp: str, joints: tuple[str, ...], **facts) -> RobotProfile:
    urdf = (DATA / f"{name}.urdf").read_text()
    return RobotProfile(
        name=name, urdf=urdf, base_link=base, tcp_link=tcp, arm_joints=joints, **facts
    )


def seven(**facts) -> RobotProfile:
    return robot("seven", "base", "tcp", SEVEN, **facts)


def loaded(profile: RobotProfile, **options) -> UrdfController:
    controller = UrdfController(UrdfControllerOptions(**options), profile)
    controller.load()
    return controller


def joints(names, position) -> JointSample:
    return JointSample(
        names=tuple(names), position=np.array(position, dtype=np.float64), stamp_ns=7
    )


def action(translation=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0), gripper=1.0) -> Action:
    return Action(
        translation_m=np.array(translation, float),
        rotation_rad=np.array(rotation, float),
        gripper_open=gripper,
    )


def distances(controller: UrdfController, asked: Action, start: JointSample, command: JointCommand):
    """Metres and radians between where the command leads and where the action wanted to go."""
    wanted = apply_delta(controller.forward(start), asked)
    reached = controller.forward(JointSample(names=command.names, position=command.position))
    turn = (
        matrix_from_quaternion(wanted.quaternion_xyzw)
        @ matrix_from_quaternion(reached.quaternion_xyzw).T
    )
    return np.linalg.norm(wanted.position_m - reached.position_m), np.linalg.norm(
        rotvec_from_matrix(turn)
    )


def test_forward_matches_the_closed_form_of_a_planar_arm():
    controller = loaded(robot("planar2", "base", "tip", ("shoulder", "elbow")))
    a, b = 0.3, -1.1
    pose = controller.forward(joints(("elbow", "shoulder"), (b, a)))
    expected = (
        0.5 * math.cos(a) + 0.4 * math.cos(a + b),
        0.5 * math.sin(a) + 0.4 * math.sin(a + b),
        0.0,
    )
    np.testing.assert_allclose(pose.position_m, expected, atol=1e-12)
    np.testing.assert_allclose(
        pose.quaternion_xyzw[2:], (math.sin((a + b) / 2), math.cos((a + b) / 2)), atol=1e-12
    )
    assert pose.stamp_ns == 7


def test_a_link_may_have_the_name_of_its_joint():
    """Public descriptions name a fixed joint as the link that it carries, at base or TCP."""
    chain = random_chain(["revolute"] * 4, seed=3)
    profile = RobotProfile(
        name="chain",
        urdf=chain.urdf,
        base_link="base",
        tcp_link="tcp",
        arm_joints=chain.arm,
        collision=CollisionProfile(min_distance_m=0.001),
    )
    named = profile.urdf
    for link in (profile.base_link, profile.tcp_link):
        fixed = (
            f'<link name="at_{link}"/><joint name="{link}" type="fixed"><parent link="{link}"/>'
            f'<child link="at_{link}"/></joint></robot>'
        )
        named = named.replace("</robot>", fixed)
    here = JointSample(names=chain.arm, position=np.full(4, 0.3))
    usual, same = loaded(profile), loaded(dataclasses.replace(profile, urdf=named))
    assert same.forward(here).position_m.tolist() == usual.forward(here).position_m.tolist()


def test_planar_arm_tracks_position_where_two_joints_cannot_track_rotation():
    profile = robot("planar2", "base", "tip", ("shoulder", "elbow"))
    start, move = joints(profile.arm_joints, (0.3, 1.0)), action((0.02, -0.03, 0.0))
    assert loaded(profile).compute(move, start, 0.1).code == "no_solution"
    controller = loaded(profile, track="position")
    command = controller.compute(move, start, 0.1)
    assert isinstance(command, JointCommand)
    assert distances(controller, move, start, command)[0] < 1e-4


def test_six_joint_arm_with_a_continuous_wrist_is_moved_in_the_frame_of_its_base_link():
    profile = robot("six", "base", "tool", SIX)
    controller = loaded(profile)
    start = joints(SIX, (0.2, -1.2, 1.5, -1.9, -1.5, 40.0))
    move = action((0.03, -0.02, 0.04), (0.05, -0.1, 0.08))
    command = controller.compute(move, start, 0.1)
    assert isinstance(command, JointCommand)
    off_m, off_rad = distances(controller, move, start, command)
    assert off_m < 1e-4
    assert off_rad < 1e-3
    assert abs(command.position[5] - 40.0) < 0.3
    assert np.linalg.norm(controller.forward(start).position_m) < 1.2, (
        "the pose is relative to base, not to world"
    )


def test_telescope_counts_the_stage_that_mimics():
    profile = robot("gantry", "frame", "stage2", ("x", "y", "z"))
    controller = loaded(profile)
    start = joints(("x", "y", "z"), (0.5, 0.5, 0.1))
    np.testing.assert_allclose(
        controller.forward(start).position_m, (0.5, 0.5, -(0.1 + 0.1 + 0.05)), atol=1e-12
    )
    command = controller.compute(action((0.02, 0.0, -0.04)), start, 0.1)
    # the tolerance of a solution
    np.testing.assert_allclose(command.position, (0.52, 0.5, 0.12), atol=1e-4)
    jump = loaded(profile, max_joint_step_m=0.01).compute(action((0.02, 0.0, 0.0)), start, 0.1)
    assert jump.code == "joint_jump"
    assert "'x'" in jump.reason


def test_command_names_the_arm_and_the_gripper_and_ignores_other_measured_joints():
    gripper = GripperProfile(joint="finger", closed_position=0.0, open_position=0.04)
    controller = loaded(seven(gripper=gripper))
    start = joints(
        ("finger", *reversed(SEVEN), "finger_mirror"), (0.04, *reversed(SEVEN_HOME), 0.04)
    )
    command = controller.compute(action((0.01, 0.0, 0.0), gripper=0.25), start, 0.1)
    assert command.names == (*SEVEN, "finger")
    assert command.position[-1] == pytest.approx(0.01)
    assert command.residual_m <= 1e-4
    assert command.residual_rad <= 1e-3


def test_zero_action_keeps_the_measured_posture():
    start = joints(SEVEN, SEVEN_HOME)
    command = loaded(seven()).compute(action(), start, 0.1)
    np.testing.assert_array_equal(command.position, start.position)
    assert command.duration_s == 0.1


def test_action_of_a_hundredth_of_a_millimetre_still_moves_the_arm():
    controller = loaded(seven())
    start, move = joints(SEVEN, SEVEN_HOME), action((0.0, 0.0, 2e-5))
    command = controller.compute(move, start, 0.1)
    assert distances(controller, move, start, command)[0] < 1.1e-5


def test_slow_joints_get_more_time_instead_of_more_speed():
    limits = JointLimits(
        lower=np.full(7, -2.8),
        upper=np.full(7, 2.8),
        velocity=np.full(7, 0.1),
        acceleration=np.full(7, 10.0),
        effort=np.full(7, 80.0),
    )
    start = joints(SEVEN, SEVEN_HOME)
    command = loaded(seven(limits=limits), velocity_fraction=0.5).compute(
        action((0.0, 0.0, 0.05)), start, 0.1
    )
    fastest = np.abs(command.position - start.position).max() / command.duration_s
    assert fastest == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        (action((0.1, 0.0, 0.0)), "action_too_large"),
        (action(rotation=(0.0, 0.4, 0.0)), "action_too_large"),
        (action((math.nan, 0.0, 0.0)), "bad_action"),
        (action((math.inf, 0.0, 0.0)), "bad_action"),
        (action(gripper=1.5), "bad_action"),
        (action(gripper=math.nan), "bad_action"),
        (
            Action(translation_m=np.zeros(2), rotation_rad=np.zeros(3), gripper_open=1.0),
            "bad_action",
        ),
    ],
)
def test_bad_action_is_refused_by_code(asked, code):
    refusal = loaded(seven()).compute(asked, joints(SEVEN, SEVEN_HOME), 0.1)
    assert isinstance(refusal, Hold)
    assert refusal.code == code


@pytest.mark.parametrize("step_s", [0.0, -1.0, math.nan, math.inf])
def test_step_time_that_is_not_a_positive_number_is_refused(step_s):
    assert loaded(seven()).compute(action(), joints(SEVEN, SEVEN_HOME), step_s).code == "bad_action"


def test_missing_joint_is_named_in_the_refusal():
    refusal = loaded(seven()).compute(action(), joints(SEVEN[:-1], SEVEN_HOME[:-1]), 0.1)
    assert refusal.code == "unknown_joint"
    assert "j7" in refusal.reason


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_joint_that_is_not_finite_is_refused_and_has_no_pose(bad):
    controller = loaded(seven())
    start = joints(SEVEN, (bad, *SEVEN_HOME[1:]))
    refusal = controller.compute(action(), start, 0.1)
    assert refusal.code == "bad_state"
    assert "j1" in refusal.reason
    with pytest.raises(UnsafeError, match="j1"):
        controller.forward(start)


def test_names_and_positions_of_different_length_are_refused():
    start = JointSample(names=SEVEN, position=np.zeros(6))
    assert loaded(seven()).compute(action(), start, 0.1).code == "bad_state"


def test_start_outside_the_limits_is_refused_beyond_the_slack():
    controller = loaded(seven())
    near = joints(SEVEN, (2.905, *SEVEN_HOME[1:]))
    command = controller.compute(action(), near, 0.1)
    assert isinstance(command, JointCommand)
    assert command.position[0] <= 2.9
    refusal = controller.compute(action(), joints(SEVEN, (2.95, *SEVEN_HOME[1:])), 0.1)
    assert refusal.code == "outside_limits"
    assert "'j1'" in refusal.reason


def test_target_outside_the_workspace_is_refused_and_the_way_back_is_not():
    start = joints(SEVEN, SEVEN_HOME)
    here = loaded(seven()).forward(start).position_m
    box = Workspace(lower_m=here - (1.0, 1.0, 0.01), upper_m=here + 1.0)
    refusal = loaded(seven(workspace=box)).compute(action((0.0, 0.0, -0.03)), start, 0.1)
    assert refusal.code == "outside_workspace"
    below = dataclasses.replace(box, lower_m=here + np.array([-1.0, -1.0, 0.05]))
    controller = loaded(seven(workspace=below))
    assert isinstance(controller.compute(action((0.0, 0.0, 0.03)), start, 0.1), JointCommand)
    assert isinstance(controller.compute(action(), start, 0.1), JointCommand)
    assert controller.compute(action((0.0, 0.0, -0.01)), start, 0.1).code == "outside_workspace"


def test_target_out_of_reach_is_refused_with_its_residual():
    straight = joints(SEVEN, (0.0,) * 7)
    refusal = loaded(seven()).compute(action((0.0, 0.0, 0.05)), straight, 0.1)
    assert refusal.code == "no_solution"
    assert "mm" in refusal.reason
    assert "mrad" in refusal.reason


def test_jump_of_a_joint_is_refused():
    refusal = loaded(seven(), max_joint_step_rad=0.01).compute(
        action((0.0, 0.05, 0.0)), joints(SEVEN, SEVEN_HOME), 0.1
    )
    assert refusal.code == "joint_jump"


def test_use_before_load_and_after_close_is_an_error():
    controller = UrdfController(None, seven())
    start = joints(SEVEN, SEVEN_HOME)
    with pytest.raises(StateError, match="load"):
        controller.compute(action(), start, 0.1)
    controller.load()
    controller.close()
    controller.close()
    with pytest.raises(StateError, match="load"):
        controller.forward(start)


@pytest.fixture(scope="module")
def seven_controller() -> UrdfController:
    return loaded(seven())


unit = st.floats(-1.0, 1.0)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    where=st.lists(st.floats(0.0, 1.0), min_size=7, max_size=7),
    move=st.tuples(unit, unit, unit),
    turn=st.tuples(unit, unit, unit),
)
def test_any_posture_gives_a_command_within_tolerance_or_a_refusal(
    seven_controller, where, move, turn
):
    """Postures uniform within the limits, singular ones among them: never a wrong command."""
    controller = seven_controller
    lower = np.array([-2.9, -1.8, -2.9, -2.6, -2.9, -2.1, -3.0])
    start = joints(SEVEN, lower - 2 * lower * np.array(where))
    asked = action(np.array(move) * 0.045, np.array(turn) * 0.15)
    answer = controller.compute(asked, start, 0.1)
    if isinstance(answer, Hold):
        assert answer.code in HOLD_CODES
        assert answer.reason
        return
    off_m, off_rad = distances(controller, asked, start, answer)
    assert off_m <= 1e-4
    assert off_rad <= 1e-3
    assert (np.abs(answer.position) <= -lower).all()
    assert np.abs(answer.position - start.position).max() <= 0.3


def edited(old: str, new: str) -> RobotProfile:
    profile = seven()
    assert old in profile.urdf
    return dataclasses.replace(profile, urdf=profile.urdf.replace(old, new))


@pytest.mark.parametrize(
    ("profile", "message"),
    [
        (dataclasses.replace(seven(), urdf="<robot"), "not XML"),
        (dataclasses.replace(seven(), urdf="<sdf/>"), "<sdf>"),
        (dataclasses.replace(seven(), tcp_link="tool0"), "tool0"),
        (dataclasses.replace(seven(), base_link="l7", tcp_link="base"), "does not hang"),
        (dataclasses.replace(seven(), arm_joints=(*SEVEN, "finger")), "finger"),
        (dataclasses.replace(seven(), arm_joints=SEVEN[:-1]), "j7"),
        (dataclasses.replace(seven(), arm_joints=()), "none given"),
        (edited('name="j3" type="revolute"', 'name="j3" type="floating"'), "floating"),
        (edited('<limit lower="-2.1" upper="2.1"', '<limit lower="2.1" upper="-2.1"'), "j6"),
        (edited('<limit lower="-2.1" upper="2.1"', '<limit lower="low" upper="2.1"'), "'low'"),
        (
            edited(
                '<axis xyz="0 -1 0"/>\n    <limit lower="-2.6"',
                '<axis xyz="0 0 0"/>\n    <limit lower="-2.6"',
            ),
            "j4",
        ),
        (edited('<parent link="l6"/>', "<parent/>"), "parent"),
        (robot("gantry", "frame", "stage2", ("x", "y", "z", "z_second")), "mimics"),
        (robot("gantry", "frame", "stage2", ("x", "y")), "z"),
    ],
)
def test_description_that_makes_no_arm_is_refused_by_name(profile, message):
    with pytest.raises(ConfigurationError, match=message):
        UrdfController(None, profile).load()


def test_limits_of_the_wrong_size_are_refused():
    short = JointLimits(
        lower=-np.ones(6),
        upper=np.ones(6),
        velocity=np.ones(6),
        acceleration=np.ones(6),
        effort=np.ones(6),
    )
    with pytest.raises(ConfigurationError, match="7 arm joints"):
        UrdfController(None, seven(limits=short)).load()
