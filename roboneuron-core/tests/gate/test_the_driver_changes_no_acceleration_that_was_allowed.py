"""Control and the gate are stricter on a joint's acceleration than the limits in front of the
driver: what they allow keeps its time there.
"""

from __future__ import annotations

import math

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from roboneuron.gate.motion.acceleration import JointAccelerations, Speeds, change_s
from roboneuron.gate.motion.joint_space import JointLimit

times_s = st.floats(1e-3, 2.0)
limits = st.floats(0.1, 30.0)
ROUNDING = 1.0 + 4 * JointLimit.SLACK


@given(
    before=st.floats(-3.0, 3.0),
    wanted=st.floats(-6.0, 6.0),
    limit=limits,
    since_s=times_s,
    duration_s=times_s,
)
def test_a_step_that_control_allows_has_its_time(
    before: float, wanted: float, limit: float, since_s: float, duration_s: float
) -> None:
    joints = JointAccelerations(("a",), [JointLimit(acceleration=limit)])
    passed_s = min(since_s, duration_s)
    velocity, _ = joints.nearest_velocity(np.array([before]), np.array([wanted]), passed_s)
    speed = float(velocity[0])
    along = max(0.0, math.copysign(1.0, speed) * before)
    needed_s = change_s(abs(speed) * duration_s, along, limit, since_s)
    assert needed_s <= duration_s * ROUNDING + 1e-9


@given(
    first=st.floats(-1.0, 1.0),
    second=st.floats(-1.0, 1.0),
    limit=limits,
    first_s=times_s,
    second_s=times_s,
)
def test_a_path_that_the_gate_allows_has_its_time(
    first: float, second: float, limit: float, first_s: float, second_s: float
) -> None:
    speeds = Speeds(0.0, 0.0).after(first, first_s, limit, math.inf)
    assume(speeds is not None)
    assert speeds is not None
    assert change_s(abs(first), 0.0, limit, math.inf) <= first_s * ROUNDING
    assume(speeds.after(second, second_s, limit, math.inf) is not None)
    along = max(0.0, math.copysign(1.0, second) * first / first_s)
    assert change_s(abs(second), along, limit, first_s) <= second_s * ROUNDING
