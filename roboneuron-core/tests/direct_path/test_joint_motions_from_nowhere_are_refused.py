"""Joints that nobody has measured are not moved: nobody could judge their way or their speed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import Endpoint, JointLimits, JointSample, RobotProfile
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.errors import RefusedError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.feature import GateRequest
from roboneuron.gate import AuditLog

Ask = Callable[..., GateRequest]
NO_ACCELERATION_LIMIT = RobotProfile(
    name="arm",
    arm_joints=("j1",),
    limits=JointLimits(
        lower=np.full(1, -1.0),
        upper=np.ones(1),
        velocity=np.ones(1),
        acceleration=np.full(1, math.inf),
        effort=np.ones(1),
    ),
)


class AnyPath:
    """A judge that finds nothing wrong."""

    def __init__(self) -> None:
        self.asked: list[JointSample] = []

    def check(self, legs: object, joints: JointSample) -> None:
        self.asked.append(joints)


def test_a_position_without_a_time_is_refused_while_no_joint_was_measured(
    make_gate: Callable[..., Gate], ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    """Its way through zones and obstacles begins where the arm is."""
    path = AnyPath()
    gate = make_gate(path=lambda: path)
    request = ask(endpoints["joints"], {"name": ["j1", "j2"], "position": [0.5, 0.5]})
    assert gate.check(request).may_send
    assert path.asked == [request.joints]
    with pytest.raises(RefusedError, match="joints were not measured yet, so the arm's way"):
        gate.check(replace(request, joints=None))
    verdict = gate.check(replace(request, joints=None, simulated=True))
    assert (verdict.allowed, verdict.rule) == (False, "kinematics")


def test_without_a_judge_of_ways_a_position_needs_no_measured_joints(
    make_gate: Callable[..., Gate], ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    request = ask(endpoints["joints"], {"name": ["j1"], "position": [0.5]}, joints=None)
    assert make_gate().check(request).may_send


@pytest.mark.parametrize("unknown", [math.nan, math.inf])
def test_a_joint_whose_measured_position_is_no_number_counts_as_not_measured(
    latch: EmergencyStopLatch,
    audit: AuditLog,
    clock: Any,
    ask: Ask,
    endpoints: dict[str, Endpoint],
    unknown: float,
) -> None:
    """A comparison with NaN is never true, so that no speed would be too high."""
    entry = AllowedEndpoint(
        robot="arm", endpoint=endpoints["trajectory"], profile=NO_ACCELERATION_LIMIT
    )
    gate = Gate([entry], latch=latch, audit=audit, clock=clock.monotonic)
    value = {"joint_names": ["j1"], "points": [{"positions": [0.9], "time_from_start": 1.0}]}
    here = JointSample(names=("j1",), position=np.zeros(1))
    assert gate.check(ask(endpoints["trajectory"], value, joints=here)).may_send
    nowhere = replace(here, position=np.array([unknown]))
    with pytest.raises(RefusedError, match="'j1' is not among the measured ones"):
        gate.check(ask(endpoints["trajectory"], value, joints=nowhere))
