"""The boxes around links hold their collision shapes at every posture, and not much more."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pinocchio
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_controller_urdf.shapes import HELD_M, LinkBoxes
from rn_robot_fr3.profile import pair_profile, profile
from roboneuron import EE_DELTA, JointSample, RobotProfile, UnsafeError
from roboneuron.config import LimitsConfig
from roboneuron.gate.motion import motion_rules
from roboneuron.gate.motion.limiter import MotionLimiter
from roboneuron.tools.arm.prediction import ArmControl

FINGER = "fr3_finger_joint1"


def postures(robot: RobotProfile, count: int) -> list[JointSample]:
    rng = np.random.default_rng(7)
    assert robot.limits is not None
    return [
        JointSample(
            names=robot.arm_joints, position=rng.uniform(robot.limits.lower, robot.limits.upper)
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize("robot", [profile(), pair_profile()], ids=["one", "two"])
def test_boxes_hold_the_shapes(robot: RobotProfile) -> None:
    model = pinocchio.buildModelFromXML(robot.urdf)
    shapes = pinocchio.buildGeomFromUrdfString(model, robot.urdf, pinocchio.GeometryType.COLLISION)
    data, placed = model.createData(), shapes.createData()
    base = model.getFrameId(robot.base_link)
    boxes = LinkBoxes(robot)
    controller = UrdfController(None, robot)
    controller.load()
    for joints in postures(robot, 40):
        found = boxes.extents(joints, controller.poses(joints))
        told = {name: (found.lower_m[i], found.upper_m[i]) for i, name in enumerate(found.names)}
        full = pinocchio.neutral(model)
        for name, value in zip(joints.names, joints.position, strict=True):
            full[model.joints[model.getJointId(name)].idx_q] = value
        pinocchio.framesForwardKinematics(model, data, full)
        pinocchio.updateGeometryPlacements(model, data, shapes, placed)
        for index, shape in enumerate(shapes.geometryObjects):
            link = model.frames[shape.parentFrame].name
            if not shape.parentJoint:
                assert link not in told
                continue
            there = data.oMf[base].actInv(placed.oMg[index])
            points = _surface(shape.geometry) @ there.rotation.T + there.translation
            lower, upper = told[link]
            assert (points.min(axis=0) >= lower - 1e-9).all()
            assert (points.max(axis=0) <= upper + 1e-9).all()


def _surface(geometry: object) -> np.ndarray:
    """Points on the surface of a box or cylinder."""
    rng = np.random.default_rng(3)
    unit = rng.uniform(-1.0, 1.0, (200, 3))
    if hasattr(geometry, "halfSide"):
        return np.sign(unit) * geometry.halfSide
    angles = np.arctan2(unit[:, 1], unit[:, 0])
    ring = geometry.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)  # type: ignore[attr-defined]
    return np.column_stack([ring, np.sign(unit[:, 2]) * geometry.halfLength])  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("opening_m", "may_hold"), [(0.04, False), (0.02, True), (0.0, True), (None, True)]
)
def test_a_hand_that_is_not_open_may_hold_something(
    opening_m: float | None, may_hold: bool
) -> None:
    robot = profile()
    controller = UrdfController(None, robot)
    controller.load()
    assert robot.home_rad is not None
    joints = JointSample(names=robot.arm_joints, position=robot.home_rad)
    if opening_m is not None:
        joints = JointSample(
            names=(*joints.names, FINGER), position=np.append(joints.position, opening_m)
        )
    posture = controller.inspect(joints)
    assert posture.extents is not None
    found = posture.extents()
    held = [i for i, name in enumerate(found.names) if "holds" in name]
    assert bool(held) is may_hold
    for i in held:
        assert found.lower_m[i] == pytest.approx(posture.pose.position_m - HELD_M)


def test_links_without_shapes_cannot_be_told() -> None:
    robot = profile()
    root = robot.urdf
    bare = replace(robot, urdf=_without_shapes(root), collision=None)
    controller = UrdfController(None, bare)
    controller.load()
    assert robot.home_rad is not None
    joints = JointSample(names=robot.arm_joints, position=robot.home_rad)
    posture = controller.inspect(joints)
    assert posture.extents is not None
    with pytest.raises(UnsafeError):
        posture.extents()


def _without_shapes(urdf: str) -> str:
    return re.sub(r"<collision.*?</collision>", "", urdf, flags=re.DOTALL)


WALL = {"name": "wall", "lower_m": [-9.0, 0.22, -9.0], "upper_m": [9.0, 9.0, 9.0]}
VASE = {"name": "vase", "lower_m": [0.4, -0.4, 0.0], "upper_m": [0.6, -0.2, 0.3]}
BULGE_M = 0.003
"""Between two postures that are compared, a link passes a few millimetres beside their line."""


@pytest.mark.parametrize("seed", range(3))
def test_no_sequence_of_actions_brings_a_link_into_a_zone_of_the_arm(seed: int) -> None:
    robot = profile()
    zones = [{**zone, "applies_to": "arm"} for zone in (WALL, VASE)]
    controller = UrdfController(None, robot)
    controller.load()
    assert robot.home_rad is not None
    joints = JointSample(
        names=(*robot.arm_joints, FINGER), position=np.append(robot.home_rad, 0.04)
    )
    rules = motion_rules(LimitsConfig.model_validate({"zones": zones}), robot)
    limiter = MotionLimiter.of(rules, robot, controller, immediate=False, longest_s=2.0)
    limiter.rest(joints, 0.0)
    control = ArmControl(controller, limiter, robot, rules)
    truth = _Truth(robot, [WALL, VASE])
    random, refused, action = np.random.default_rng(seed), 0, np.zeros(7)
    for step in range(250):
        if step % 12 == 0:  # goes on in one direction: against the limits
            action = np.concatenate(
                [random.uniform(-0.03, 0.03, 3), random.uniform(-0.1, 0.1, 3), [1.0]]
            )
            action[:2] = np.sign(random.uniform(-1.0, 1.0, 2)) * 0.02
        now_s = 0.1 * (step + 1)
        answered = control.answer(EE_DELTA, action, joints, now_s, 0.1)
        refused += "zone" in answered.rules
        if answered.command is None:
            limiter.rest(joints, now_s)
            continue
        share = min(1.0, 0.1 / answered.command.duration_s)
        ends = [answered.command.get(name) for name in joints.names]
        pairs = zip(joints.position, ends, strict=True)
        target = np.array([here if end is None else end for here, end in pairs])
        joints = JointSample(
            names=joints.names, position=joints.position + share * (target - joints.position)
        )
        assert truth.depth_m(joints) <= BULGE_M
    assert refused > 0, "the limits were reached"


class _Truth:
    """Depths of shapes in boxes, by distances that the limits do not use."""

    def __init__(self, robot: RobotProfile, zones: list[dict[str, object]]) -> None:
        self._model = pinocchio.buildModelFromXML(robot.urdf)
        self._shapes = pinocchio.buildGeomFromUrdfString(
            self._model, robot.urdf, pinocchio.GeometryType.COLLISION
        )
        self._data, self._placed = self._model.createData(), self._shapes.createData()
        self._base = self._model.getFrameId(robot.base_link)
        self._boxes = [(np.array(zone["lower_m"]), np.array(zone["upper_m"])) for zone in zones]

    def depth_m(self, joints: JointSample) -> float:
        """How deep the surface of any moving shape is in a box, sampled [m]."""
        full = pinocchio.neutral(self._model)
        for name, value in zip(joints.names, joints.position, strict=True):
            full[self._model.joints[self._model.getJointId(name)].idx_q] = value
        pinocchio.framesForwardKinematics(self._model, self._data, full)
        pinocchio.updateGeometryPlacements(self._model, self._data, self._shapes, self._placed)
        deepest = 0.0
        for index, shape in enumerate(self._shapes.geometryObjects):
            if shape.parentJoint:
                there = self._data.oMf[self._base].actInv(self._placed.oMg[index])
                points = _surface(shape.geometry) @ there.rotation.T + there.translation
                for lower, upper in self._boxes:
                    inside = np.minimum(points - lower, upper - points).min(axis=1)
                    deepest = max(deepest, float(inside.max()))
        return deepest
