"""What the controller "urdf" tells of a posture: TCP, distance from a singularity, links that touch each other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_controller_urdf.options import UrdfControllerOptions
from roboneuron.contract import Hold, JointCommand, JointSample, PostureInspector, RobotProfile
from roboneuron.contract.action import Action
from roboneuron.errors import ConfigurationError, StateError, UnsafeError

JOINTS = ("q1", "q2", "q3")
BAR = '<collision><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.04 0.04"/></geometry></collision>'


def planar(shape: str = BAR) -> RobotProfile:
    """Three bars of 0.3 m that turn about z, the last one with a TCP at its end."""
    links = ['<link name="base"/>', *(f'<link name="bar{i}">{shape}</link>' for i in (1, 2, 3)), '<link name="tcp"/>']
    parents, origins = ("base", "bar1", "bar2"), ("0 0 0", "0.3 0 0", "0.3 0 0")
    moving = [
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="bar{i}"/>'
        f'<origin xyz="{origin}"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" effort="9"/></joint>'
        for i, (name, parent, origin) in enumerate(zip(JOINTS, parents, origins, strict=True), start=1)
    ]
    tip = '<joint name="tip" type="fixed"><parent link="bar3"/><child link="tcp"/><origin xyz="0.3 0 0"/></joint>'
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
    posture, pose = controller.inspect(sample(0.2, 0.5, -0.3)), controller.forward(sample(0.2, 0.5, -0.3))
    np.testing.assert_array_equal(posture.pose.position_m, pose.position_m)
    np.testing.assert_array_equal(posture.pose.quaternion_xyzw, pose.quaternion_xyzw)
    assert posture.contact is None


def test_smallest_singular_value_is_that_of_the_measured_jacobian() -> None:
    """Rows of the Jacobian by differences: turning about z moves the TCP in x and y and turns it."""
    controller, position, step = loaded(), np.array([0.2, 0.5, -0.8]), 1e-6
    columns = []
    for joint in range(3):
        moved = position.copy()
        moved[joint] += step
        change = controller.forward(sample(*moved)).position_m - controller.forward(sample(*position)).position_m
        columns.append([*(change / step), 0.0, 0.0, 1.0])
    expected = np.linalg.svd(np.array(columns).T, compute_uv=False)[-1]
    value = controller.inspect(sample(*position)).smallest_singular_value
    assert value == pytest.approx(expected, rel=1e-4)  # differences of 1e-6 rad


def test_smallest_singular_value_vanishes_for_a_stretched_arm() -> None:
    assert loaded().inspect(sample(0.4, 0.0, 0.0)).smallest_singular_value == pytest.approx(0.0, abs=1e-9)
    assert loaded().inspect(sample(0.4, 0.9, 0.9)).smallest_singular_value > 0.05


@pytest.mark.parametrize(
    ("position", "contact"), [((0.0, 0.6, 0.6), ""), ((0.0, 1.5, 1.5), ""), ((0.0, 2.6, 2.6), "bar1 and bar3")]
)
def test_links_that_touch_are_named(position: tuple[float, float, float], contact: str) -> None:
    assert loaded(self_collision=True).inspect(sample(*position)).contact == contact


def test_margin_counts_links_that_are_merely_close() -> None:
    """Folded to a U, the outer bars are parallel with 0.26 m of air between them."""
    u_shape = sample(0.0, math.pi / 2, math.pi / 2)
    assert loaded(self_collision=True, self_collision_margin_m=0.01).inspect(u_shape).contact == ""
    tight = sample(0.0, 2.4, 1.2)
    assert loaded(self_collision=True, self_collision_margin_m=0.0).inspect(tight).contact == ""
    assert loaded(self_collision=True, self_collision_margin_m=0.15).inspect(tight).contact == "bar1 and bar3"


def test_commands_are_the_same_with_and_without_inspection() -> None:
    controller, start = loaded(track="position"), sample(0.2, 0.5, 0.9)
    action = Action(translation_m=np.array([0.0, 0.01, 0.0]), rotation_rad=np.zeros(3), gripper_open=1.0)
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
        ('<collision><geometry><mesh filename="x.stl"/></geometry></collision>', "meshes"),
    ],
)
def test_self_collision_without_usable_shapes_is_refused(shape: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        loaded(planar(shape), self_collision=True)


def test_links_that_touch_at_home_are_not_compared() -> None:
    folded = replace(planar(), home_rad=np.array([0.0, 2.6, 2.6]))
    with pytest.raises(ConfigurationError, match="no two links"):  # bar1 and bar3 are the only pair
        loaded(folded, self_collision=True)
