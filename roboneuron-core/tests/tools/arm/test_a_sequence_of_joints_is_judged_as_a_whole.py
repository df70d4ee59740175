"""Several calls of move_joints are judged together, from where the arm stands, and move nothing."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron.config import LimitsConfig
from roboneuron.contract import JointLimits, JointSample, Pose, Posture, RobotProfile
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError
from roboneuron.gate.motion.joint_paths import check_joints
from roboneuron.gate.motion.joint_space import JointLimit
from roboneuron.gate.motion.path_limits import PathLimiter
from roboneuron.gate.motion.rules import motion_rules
from roboneuron.server.verdict import Verdict
from roboneuron.tools.arm.joints import JointMover

NAMES = ("x", "y")
PROFILE = RobotProfile(
    name="arm",
    arm_joints=NAMES,
    tcp_link="tcp",
    limits=JointLimits(
        lower=np.full(2, -2.0),
        upper=np.full(2, 2.0),
        velocity=np.full(2, 1.0),
        acceleration=np.full(2, 4.0),
        effort=np.ones(2),
    ),
)
PANE = {"name": "pane", "lower_m": [0.5, 0.5, 0.0], "upper_m": [1.5, 1.5, 1.0]}
CONTEXT: Any = SimpleNamespace(who="agent", role="operator", simulated=False)


def inspect(joints: JointSample) -> Posture:
    at = np.array([*joints.position.tolist(), 0.4])
    return Posture(pose=Pose(position_m=at, quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0])))


class JudgingGate:
    """Judges joint paths as the gate does; keeps its requests."""

    max_duration_s = 120.0

    def __init__(self, **more: float) -> None:
        limits = LimitsConfig.model_validate({"zones": [PANE], "max_speed_m_s": 2.0, **more})
        self.rules = motion_rules(limits, PROFILE)
        self.paths = PathLimiter(self.rules, PROFILE, inspect)
        self.here: JointSample | None = JointSample(names=NAMES, position=np.zeros(2))
        self.requests: list[Any] = []

    def joints(self, exposed: Any, timeout_s: float) -> JointSample | None:
        return self.here

    def slowdown(self, request: Any) -> float:
        return 1.0

    def joint_limits(self, exposed: Any) -> Mapping[str, JointLimit]:
        return JointLimit.by_joint(PROFILE, self.rules)

    def ask(self, exposed: Any, request: Any) -> Verdict:
        self.requests.append(request)
        try:
            legs = check_joints(self.joint_limits(exposed), request.messages, request.joints)
            self.paths.check(legs, request.joints)
        except RefusedError as error:
            return Verdict(allowed=False, simulated=True, reason=str(error), rule=error.rule)
        return Verdict(allowed=True, simulated=True)


@pytest.fixture
def gate() -> JudgingGate:
    return JudgingGate()


def mover_of(gate: JudgingGate) -> JointMover:
    exposed: Any = SimpleNamespace(
        profile=PROFILE, robot="arm", namespace="arm", endpoint=SimpleNamespace(name="trajectory")
    )
    host: Any = SimpleNamespace(
        clock=lambda namespace: None,
        modules=SimpleNamespace(view=lambda kind: SimpleNamespace(phase="stopped")),
        config=SimpleNamespace(namespace="arm"),
    )
    judging: Any = gate
    return JointMover(exposed, JointLimit.by_joint(PROFILE), judging, host)


@pytest.fixture
def mover(gate: JudgingGate) -> JointMover:
    return mover_of(gate)


@pytest.mark.parametrize("fraction", ["velocity_fraction", "acceleration_fraction"])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 1.0])
def test_a_move_without_a_duration_is_as_slow_as_the_limits_in_force(
    fraction: str, share: float
) -> None:
    gate = JudgingGate(**{fraction: share})
    mover_of(gate).check_path([{"x": 0.4}, {"x": 0.0}], CONTEXT)  # it would raise
    usual, slow = JudgingGate(), gate
    mover_of(usual).check_path([{"x": 0.4}, {"x": 0.0}], CONTEXT)
    lasts_s = [found.requests[0].send_at_s[1] for found in (usual, slow)]
    assert lasts_s[1] >= lasts_s[0]
    assert lasts_s[1] > lasts_s[0] or share == 1.0 or fraction == "acceleration_fraction"


def test_steps_that_are_allowed_one_after_the_other_pass(
    mover: JointMover, gate: JudgingGate
) -> None:
    mover.check_path([{"x": 1.0}, {"x": 0.0}, {"y": 1.0}], CONTEXT)
    (request,) = gate.requests
    assert request.simulated
    assert len(request.messages) == len(request.send_at_s) == 3
    assert request.send_at_s[0] == 0.0 < request.send_at_s[1] < request.send_at_s[2]


def test_a_step_that_is_forbidden_only_after_the_ones_before_is_named(mover: JointMover) -> None:
    mover.check_path([{"y": 1.0}], CONTEXT)
    with pytest.raises(RefusedError) as caught:
        mover.check_path([{"x": 0.7}, {"y": 0.2}, {"y": 0.6}, {"y": 1.0}], CONTEXT)
    assert caught.value.rule == "zone"
    assert "steps[2]: " in caught.value.message
    assert "Deepest, by 200 mm: steps[2]" not in caught.value.message
    assert "steps[3]: " in caught.value.message


def test_a_position_out_of_range_and_joints_that_are_not_measured_are_told(
    mover: JointMover, gate: JudgingGate
) -> None:
    with pytest.raises(InvalidInputError):
        mover.check_path([{"x": 0.1}, {"x": 2.5}], CONTEXT)
    gate.here = None
    with pytest.raises(NotReadyError, match="not measured"):
        mover.check_path([{"x": 0.1}], CONTEXT)
    assert gate.requests == []
