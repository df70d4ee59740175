"""Kinds of joints, followers, whole turns and orders of elements and messages make no difference to
what the controller, the pictures, the recordings and the kit say of a posture.

Judged by `rn_testing.robot_judge`, which shares no code with them.
"""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rn_controller_urdf.controller import UrdfController
from rn_controller_urdf.options import UrdfControllerOptions
from rn_recorder_runs.transforms import RobotTransforms
from rn_testing.kinematics import place_tcp
from rn_testing.robot_judge import JudgedRobot, RandomChain, random_chain
from rn_view.visualization.robot_model import RobotModel
from roboneuron import (
    Action,
    CollisionProfile,
    JointCommand,
    JointLimits,
    JointSample,
    Obstacle,
    Pose,
    RobotProfile,
    matrix_from_quaternion,
)

SAME_M = 1e-6
"""Rounding: thirty radians about each of seven axes."""
TOUCH_M = 0.01
KINDS = ("revolute", "continuous", "prismatic", "mimic")
WALL = Obstacle(
    name="wall", lower_m=np.array([0.15, -2.0, -2.0]), upper_m=np.array([0.4, 2.0, 2.0])
)
PAIRED = [
    [*pair, *more]
    for pair in itertools.product(("revolute", "continuous", "prismatic"), KINDS)
    for more in (["revolute"], ["mimic", "continuous", "mimic"])
]
"""Each kind before each other one, with one link or three beyond."""


def profile_of(chain: RandomChain, rng: random.Random) -> RobotProfile:
    endless = rng.random() < 0.5
    turning = [endless and kind == "continuous" for kind in chain.kinds.values() if kind != "mimic"]
    lower = np.array([chain.lower[name] for name in chain.arm])
    upper = np.array([chain.upper[name] for name in chain.arm])
    lower[turning], upper[turning] = -np.inf, np.inf
    count = len(chain.arm)
    return RobotProfile(
        name="chain",
        urdf=chain.urdf,
        base_link="base",
        tcp_link="tcp",
        arm_joints=chain.arm,
        limits=JointLimits(
            lower=lower,
            upper=upper,
            velocity=np.full(count, 2.0),
            acceleration=np.full(count, 8.0),
            effort=np.full(count, 9.0),
        ),
        collision=CollisionProfile(min_distance_m=TOUCH_M, obstacles=(WALL,)),
    )


def posture(chain: RandomChain, rng: random.Random) -> tuple[dict[str, float], JointSample]:
    """Positions up to several turns, and a message of them in any order, with joints that the robot
    does not have and measured followers that are late.
    """
    true = {
        name: rng.uniform(0.9 * chain.lower[name], 0.9 * chain.upper[name]) for name in chain.arm
    }
    told = dict(true)
    for name, kind in chain.kinds.items():
        if kind == "mimic" and rng.random() < 0.5:
            told[name] = rng.uniform(-1.0, 1.0)
    if rng.random() < 0.5:
        told["wheel"] = 3.0
    names = list(told)
    rng.shuffle(names)
    return true, JointSample(names=tuple(names), position=np.array([told[name] for name in names]))


def turned(chain: RandomChain, joints: JointSample, rng: random.Random) -> JointSample:
    """The same posture, in other turns of the continuous joints that nothing follows by a part of
    a turn.
    """
    judge = JudgedRobot(chain.urdf)
    zero = dict.fromkeys(chain.arm, 0.0)
    position = joints.position.copy()
    for i, name in enumerate(joints.names):
        if chain.kinds.get(name) != "continuous":
            continue
        shifts = [
            judge.position(follower, {**zero, name: 2.0}) - judge.position(follower, zero)
            for follower, kind in chain.kinds.items()
            if kind == "mimic"
        ]
        if not any(shifts):
            position[i] += 2.0 * math.pi * rng.randint(-2, 2)
    return replace(joints, position=position)


def matrix(pose: Pose) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = matrix_from_quaternion(pose.quaternion_xyzw), pose.position_m
    return made


def check_chain(kinds: list[str], seed: int) -> None:
    rng, chain = random.Random(seed), random_chain(kinds, seed)
    profile, judge = profile_of(chain, rng), JudgedRobot(chain.urdf)
    controller = UrdfController(UrdfControllerOptions(track="position"), profile)
    controller.load()
    view, transforms = RobotModel(profile), RobotTransforms(chain.urdf)
    links = [f"link{i}" for i in range(len(kinds))]
    for _ in range(3):
        true, joints = posture(chain, rng)
        for message in (joints, turned(chain, joints, rng)):
            check_places(judge, controller, view, transforms, profile, true, message)
            check_distances(judge, controller, links, true, message)
        check_step(judge, controller, profile, true, joints)


def check_places(
    judge: JudgedRobot,
    controller: UrdfController,
    view: RobotModel,
    transforms: RobotTransforms,
    profile: RobotProfile,
    true: dict[str, float],
    message: JointSample,
) -> None:
    """The TCP of the controller, of the picture, of the kit and of a recording."""
    expected = judge.pose("tcp", true, "base")
    told = dict(zip(message.names, message.position.tolist(), strict=True))
    found = {
        "controller": matrix(controller.forward(message)),
        "view": view.tcps_of(told)[""],
        "kit": matrix(place_tcp(profile, told)),
        "recording": recorded(transforms, told),
    }
    for who, place in found.items():
        np.testing.assert_allclose(place, expected, atol=SAME_M, err_msg=who)


def recorded(transforms: RobotTransforms, told: dict[str, float]) -> np.ndarray:
    """Pose of the TCP by the transforms of a recording."""
    below = {pose.child: pose for pose in transforms.poses(told)}
    pose, link = np.eye(4), "tcp"
    while link in below:
        step = below[link]
        pose = matrix(Pose(position_m=step.position_m, quaternion_xyzw=step.quaternion_xyzw)) @ pose
        link = step.parent
    return pose


def check_distances(
    judge: JudgedRobot,
    controller: UrdfController,
    links: list[str],
    true: dict[str, float],
    message: JointSample,
) -> None:
    """Every pair of links that no joint connects, and of links and the wall."""
    apart = {
        frozenset(pair): judge.distance(*pair, true)
        for pair in itertools.combinations(links, 2)
        if abs(links.index(pair[0]) - links.index(pair[1])) > 1
    } | {
        frozenset((link, "wall")): judge.box_distance(
            link, true, "base", WALL.lower_m, WALL.upper_m
        )
        for link in links
    }
    told = {
        frozenset((pair.first, pair.second)): pair.distance_m
        for pair in controller.distances(message)
    }
    assert told.keys() == apart.keys()
    for pair, distance_m in apart.items():
        if distance_m > 0.0:  # the depth of an overlap has several definitions
            assert told[pair] == pytest.approx(distance_m, abs=SAME_M), pair
        assert (told[pair] < 0.0) == (distance_m < 0.0) or abs(distance_m) < SAME_M, pair
    near = controller.inspect(message).near
    assert near is not None
    found = {frozenset((pair.first, pair.second)) for pair in near}
    for pair, distance_m in apart.items():
        assert (pair in found) == (distance_m < TOUCH_M) or abs(distance_m - TOUCH_M) < SAME_M


def check_step(
    judge: JudgedRobot,
    controller: UrdfController,
    profile: RobotProfile,
    true: dict[str, float],
    message: JointSample,
) -> None:
    """A step of inverse kinematics ends where it says, near the joints that were measured."""
    action = Action(
        translation_m=np.array([0.004, -0.003, 0.002]), rotation_rad=np.zeros(3), gripper_open=1.0
    )
    command = controller.compute(action, message, 0.1)
    if not isinstance(command, JointCommand):
        return  # a singular chain
    reached = dict(zip(command.names, command.position.tolist(), strict=True))
    start, end = judge.pose("tcp", true, "base"), judge.pose("tcp", reached, "base")
    off_m = np.linalg.norm(end[:3, 3] - start[:3, 3] - action.translation_m)
    assert off_m <= command.residual_m + SAME_M
    assert all(abs(reached[name] - true[name]) <= 0.3 for name in profile.arm_joints)


@pytest.mark.sampled(every=6)
@pytest.mark.parametrize("kinds", PAIRED, ids="-".join)
def test_each_kind_before_each_other_one_is_placed_and_compared_alike(kinds: list[str]) -> None:
    check_chain(kinds, seed=len(kinds))


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=7).filter(
        lambda kinds: set(kinds) != {"mimic"}
    ),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_chain_is_placed_and_compared_as_its_judge_does(kinds: list[str], seed: int) -> None:
    check_chain(kinds, seed)


@pytest.mark.exhaustive
@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=7).filter(
        lambda kinds: set(kinds) != {"mimic"}
    ),
    seed=st.integers(0, 2**32 - 1),
)
def test_hundreds_of_chains_are_placed_and_compared_alike(kinds: list[str], seed: int) -> None:
    check_chain(kinds, seed)
