"""What the controller "urdf" tells of a posture: TCP, distance from a singularity, what is too
near.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_controller_urdf.options import UrdfControllerOptions
from roboneuron.contract import (
    CollisionProfile,
    Hold,
    JointCommand,
    JointSample,
    Obstacle,
    PostureInspector,
    RobotProfile,
)
from roboneuron.contract.action import Action
from roboneuron.errors import ConfigurationError, StateError, UnsafeError

JOINTS = ("q1", "q2", "q3")
BAR = (
    '<collision><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.04 '
    '0.04"/></geometry></collision>'
)


def planar(shape: str = BAR) -> RobotProfile:
    """Three bars of 0.3 m that turn about z, the last one with a TCP at its end."""
    links = [
        '<link name="base"/>',
        *(f'<link name="bar{i}">{shape}</link>' for i in (1, 2, 3)),
        '<link name="tcp"/>',
    ]
    parents, origins = ("base", "bar1", "bar2"), ("0 0 0", "0.3 0 0", "0.3 0 0")
    moving = [
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="bar{i}"/>'
        f'<origin xyz="{origin}"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" '
        'effort="9"/></joint>'
        for i, (name, parent, origin) in enumerate(
            zip(JOINTS, parents, origins, strict=True), start=1
        )
    ]
    tip = (
        '<joint name="tip" type="fixed"><parent link="bar3"/><child link="tcp"/><origin '
        'xyz="0.3 0 0"/></joint>'
    )
    return RobotProfile(
        name="planar",
        urdf=f'<robot name="planar">{"".join(links)}{"".join(moving)}{tip}</robot>',
        base_link="base",
        tcp_link="tcp",
        arm_joints=JOINTS,
        home_rad=np.array([0.0, 0.6, 0.6]),
    )


def loaded(profile: RobotProfile | None = None, **options: object) -> UrdfController:
    controller = UrdfController(UrdfControllerOptions.model_validate(options), profile or planar())
    controller.load()
    return controller


def sample(*position: float) -> JointSample:
    return JointSample(names=JOINTS, position=np.array(position), stamp_ns=5)


def test_inspection_is_offered_and_places_the_tcp_as_forward_does() -> None:
    controller = loaded(track="position")
    assert isinstance(controller, PostureInspector)
    posture, pose = (
        controller.inspect(sample(0.2, 0.5, -0.3)),
        controller.forward(sample(0.2, 0.5, -0.3)),
    )
    np.testing.assert_array_equal(posture.pose.position_m, pose.position_m)
    np.testing.assert_array_equal(posture.pose.quaternion_xyzw, pose.quaternion_xyzw)
    assert posture.near is None


def test_smallest_singular_value_is_that_of_the_measured_jacobian() -> None:
    """Rows of the Jacobian by differences: turning about z moves the TCP in x and y and turns
    it.
    """
    controller, position, step = loaded(), np.array([0.2, 0.5, -0.8]), 1e-6
    columns = []
    for joint in range(3):
        moved = position.copy()
        moved[joint] += step
        change = (
            controller.forward(sample(*moved)).position_m
            - controller.forward(sample(*position)).position_m
        )
        columns.append([*(change / step), 0.0, 0.0, 1.0])
    expected = np.linalg.svd(np.array(columns).T, compute_uv=False)[-1]
    value = controller.inspect(sample(*position)).smallest_singular_value
    assert value == pytest.approx(expected, rel=1e-4)  # differences of 1e-6 rad


def test_smallest_singular_value_vanishes_for_a_stretched_arm() -> None:
    assert loaded().inspect(sample(0.4, 0.0, 0.0)).smallest_singular_value == pytest.approx(
        0.0, abs=1e-9
    )
    assert loaded().inspect(sample(0.4, 0.9, 0.9)).smallest_singular_value > 0.05


def near(profile: RobotProfile, *position: float) -> dict[tuple[str, str], float]:
    """Distances [m] of what is too near."""
    found = loaded(profile).inspect(sample(*position)).near
    assert found is not None
    return {(pair.first, pair.second): pair.distance_m for pair in found}


def guarded(
    profile: RobotProfile | None = None, *obstacles: Obstacle, least_m: float = 0.0
) -> RobotProfile:
    return replace(
        profile or planar(),
        collision=CollisionProfile(min_distance_m=least_m, obstacles=tuple(obstacles)),
    )


@pytest.mark.parametrize(
    ("position", "touches"), [((0, 0.6, 0.6), False), ((0, 1.5, 1.5), False), ((0, 2.6, 2.6), True)]
)
def test_links_that_touch_are_named(position: tuple[float, float, float], touches: bool) -> None:
    found = near(guarded(), *position)
    assert list(found) == ([("bar1", "bar3")] if touches else [])
    assert all(distance_m < 0.0 for distance_m in found.values())


def test_links_that_are_merely_near_are_told_with_their_distance() -> None:
    """Folded to a U, the outer bars are parallel with 0.3 m between their axes, 0.26 m of air."""
    u_shape = (0.0, math.pi / 2, math.pi / 2)
    assert near(guarded(least_m=0.2), *u_shape) == {}
    assert near(guarded(least_m=0.3), *u_shape) == {("bar1", "bar3"): pytest.approx(0.26, abs=1e-6)}


def test_obstacles_stand_in_the_base_frame_and_are_told_by_name() -> None:
    wall = Obstacle(
        name="wall", lower_m=np.array([-1.0, 0.5, -1.0]), upper_m=np.array([1.0, 0.6, 1.0])
    )
    assert near(guarded(None, wall), 0.0, 0.1, 0.1) == {}
    assert near(guarded(None, wall), math.pi / 2, 0.0, 0.0)["bar2", "wall"] < 0.0
    # bar3 ends at y = 0.3 m
    upright = near(guarded(None, wall, least_m=0.1), 0.0, 0.0, math.pi / 2)
    assert upright == {}
    assert near(guarded(None, wall, least_m=0.25), 0.0, 0.0, math.pi / 2) == {
        ("bar3", "wall"): pytest.approx(0.2)
    }


def test_a_base_that_is_not_at_the_origin_takes_its_obstacles_along() -> None:
    shifted = replace(
        planar(),
        urdf=planar().urdf.replace(
            '<link name="base"/>',
            '<link name="world"/><link name="base"/><joint name="up" type="fixed"><parent '
            'link="world"/>'
            '<child link="base"/><origin xyz="0 0 2"/></joint>',
        ),
    )
    wall = Obstacle(
        name="wall", lower_m=np.array([-1.0, 0.5, -1.0]), upper_m=np.array([1.0, 0.6, 1.0])
    )
    assert ("bar2", "wall") in near(guarded(shifted, wall), math.pi / 2, 0.0, 0.0)
    away = replace(wall, lower_m=np.array([-1.0, 0.5, 1.0]), upper_m=np.array([1.0, 0.6, 3.0]))
    assert near(guarded(shifted, away), math.pi / 2, 0.0, 0.0) == {}


def test_tool_links_may_come_close_to_obstacles_but_not_touch_them() -> None:
    wall = Obstacle(
        name="wall", lower_m=np.array([-1.0, 0.301, -1.0]), upper_m=np.array([1.0, 0.6, 1.0])
    )
    profile = guarded(None, wall, least_m=0.01)
    assert profile.collision is not None
    posture = (0.0, 0.0, math.pi / 2)  # bar3 ends 1 mm before the wall
    assert near(profile, *posture) == {("bar3", "wall"): pytest.approx(0.001, abs=1e-6)}
    tool = replace(profile, collision=replace(profile.collision, tool_links=("bar3",)))
    assert near(tool, *posture) == {}
    assert list(near(tool, 0.0, 0.02, math.pi / 2)) == [("bar3", "wall")]
    with pytest.raises(ConfigurationError, match="'hook' has no collision shape"):
        loaded(replace(profile, collision=CollisionProfile(tool_links=("hook",))))


def test_commands_are_the_same_with_and_without_inspection() -> None:
    controller, start = loaded(track="position"), sample(0.2, 0.5, 0.9)
    action = Action(
        translation_m=np.array([0.0, 0.01, 0.0]), rotation_rad=np.zeros(3), gripper_open=1.0
    )
    first = controller.compute(action, start, 0.1)
    controller.inspect(sample(1.0, 1.0, 1.0))
    second = controller.compute(action, start, 0.1)
    assert isinstance(first, JointCommand)
    assert not isinstance(second, Hold)
    np.testing.assert_array_equal(first.position, second.position)


def test_bad_joints_cannot_be_inspected() -> None:
    with pytest.raises(UnsafeError, match="not finite"):
        loaded().inspect(sample(0.0, math.nan, 0.0))
    with pytest.raises(UnsafeError, match="lack"):
        loaded().inspect(JointSample(names=("q1",), position=np.zeros(1)))
    with pytest.raises(StateError):
        UrdfController(None, planar()).inspect(sample(0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ("", "no two links"),
        ('<collision><geometry><mesh filename="x.stl"/></geometry></collision>', "has no file"),
    ],
)
def test_collision_without_usable_shapes_is_refused(shape: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        loaded(guarded(planar(shape)))


def test_links_that_touch_at_home_are_not_compared() -> None:
    folded = replace(planar(), home_rad=np.array([0.0, 2.6, 2.6]))
    with pytest.raises(ConfigurationError, match="no two links"):  # bar1 and bar3 are the only pair
        loaded(guarded(folded))
