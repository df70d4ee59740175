"""The arm of a twin is moved by controller and limits, and what it comes near is noted."""

from __future__ import annotations

import time

import numpy as np
import pytest

from rn_standard.simulate.arm import TooLongError, TwinArm
from rn_standard.simulate.results import Survey, outside_m
from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    EE_DELTA,
    Action,
    Hold,
    JointCommand,
    JointSample,
    Obstacle,
    Pose,
    Posture,
    RobotProfile,
)
from roboneuron.gate.motion import MotionLimiter, motion_rules
from roboneuron.gate.motion.path_limits import Leg
from roboneuron.tools.arm.prediction import ArmControl

PROFILE = RobotProfile(name="gantry", arm_joints=("x", "y"))
PANE = {"name": "pane", "lower_m": [0.095, -1.0, 0.0], "upper_m": [0.105, 1.0, 1.0]}


class Gantry:
    """Two slides; the TCP is where they are."""

    def load(self) -> None:
        pass

    def forward(self, joints: JointSample) -> Pose:
        return Pose(
            position_m=np.array([*joints.position[:2], 0.3]),
            quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        )

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        if action.translation_m[2]:
            return Hold(code="no_solution", reason="It has no third axis.")
        position = joints.position + action.translation_m[:2]
        return JointCommand(names=("x", "y"), position=position, duration_s=0.1)

    def close(self) -> None:
        pass


class Slides:
    """A twin whose joints go straight to where they are sent, up to a wall."""

    scene_topic, scene_type = "", object

    def __init__(self, wall_m: float = 9.0) -> None:
        self.wall_m = wall_m
        self.sent: list[JointCommand] = []
        self._here = {"x": 0.0, "y": 0.0}

    def open(self, joints: JointSample, scene: object = None) -> None:
        pass

    def send(self, command: JointCommand) -> None:
        self.sent.append(command)

    def advance(self, duration_s: float) -> None:
        if self.sent:
            ends = zip(self.sent[-1].names, self.sent[-1].position.tolist(), strict=True)
            self._here |= {name: min(self.wall_m, end) for name, end in ends}

    def joints(self) -> JointSample:
        return JointSample(names=("x", "y"), position=np.array([*self._here.values()]))

    def moved(self) -> tuple[str, ...]:
        return ()

    def picture(self, camera: str, width: int, height: int) -> np.ndarray:
        return np.zeros((height, width, 3), dtype=np.uint8)

    def close(self) -> None:
        pass


def arm_of(twin: Slides, limit_s: float = 60.0, **limits: object) -> TwinArm:
    rules = motion_rules(LimitsConfig.model_validate(limits), PROFILE)
    gantry = Gantry()

    def inspect(joints: JointSample) -> Posture:
        return Posture(pose=gantry.forward(joints))

    limiter = MotionLimiter(rules, PROFILE, gantry.forward, inspect, longest_s=1.0)
    survey = Survey(rules, gantry)
    control = ArmControl(gantry, limiter, PROFILE, rules)
    return TwinArm(twin, control, survey, time.monotonic() + limit_s)


def move(x: float, z: float = 0.0) -> np.ndarray:
    return np.array([x, 0.0, z, 0.0, 0.0, 0.0, 1.0])


def test_a_zone_holds_the_twin_and_is_named() -> None:
    twin = Slides()
    arm = arm_of(twin, zones=[PANE])
    for _ in range(10):
        arm.follow(EE_DELTA, move(0.03), 0.1)
    assert arm.rule == "zone"
    assert "would enter 'pane'" in arm.held
    assert arm.poses()[0].position_m[0] < 0.095
    assert arm.survey.limits["zone"] >= 1
    near = arm.survey.nearest()[0]
    assert near.to == "zone pane"
    assert 0.0 < near.distance_m < 0.02


def test_a_hold_of_the_controller_is_named_and_sent_once() -> None:
    twin = Slides()
    arm = arm_of(twin)
    for _ in range(3):
        arm.follow(EE_DELTA, move(0.0, 0.1), 0.1)
    assert arm.rule == "no_solution"
    assert len(twin.sent) == 1
    arm.follow(EE_DELTA, move(0.02), 0.1)
    assert arm.rule == ""
    assert len(twin.sent) == 2


@pytest.mark.parametrize(("wall_m", "arrives"), [(9.0, True), (0.3, False)])
def test_a_path_has_arrived_only_where_it_ends(wall_m: float, arrives: bool) -> None:
    twin = Slides(wall_m)
    leg = Leg(names=("x",), position=np.array([0.5]), duration_s=1.0)
    arm = arm_of(twin)
    assert arm.play([leg]) is arrives
    assert arm.passed_s >= 1.0
    np.testing.assert_allclose(twin.joints().position, [min(wall_m, 0.5), 0.0])


def test_the_time_of_a_preview_is_bounded() -> None:
    arm = arm_of(Slides(), limit_s=0.0)
    with pytest.raises(TooLongError):
        arm.advance(1.0)


@pytest.mark.parametrize(
    ("point", "expected_m"),
    [((0.0, 0.0, 0.0), -1.0), ((0.0, 0.0, 0.9), -0.1), ((4.0, 5.0, 0.0), 5.0)],
)
def test_distances_to_boxes_are_negative_inside(
    point: tuple[float, float, float], expected_m: float
) -> None:
    box = Obstacle(name="box", lower_m=np.full(3, -1.0), upper_m=np.full(3, 1.0))
    assert outside_m(np.array(point), box) == pytest.approx(expected_m)
