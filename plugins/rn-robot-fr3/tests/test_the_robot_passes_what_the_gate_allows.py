"""A joint command that the gate allows reaches the driver as it is: the robot module's limits are
no tighter.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD, profile
from roboneuron.contract import JointCommand, JointSample
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import DriverLimiter, MotionRules
from roboneuron.gate.motion.joint_paths import check_joints
from roboneuron.gate.motion.joint_space import JointLimit
from roboneuron.ros.messages import commands_from_message, to_joint_trajectory

HOME = np.array(HOME_RAD)
AT_HOME = JointSample(names=ARM_JOINTS, position=HOME)
points = st.lists(
    st.tuples(
        st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7),
        st.sampled_from([0.01, 0.05, 0.3, 1.0, 3.0]),
        st.floats(0.01, 1.5),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=60, deadline=None)
@given(points=points)
def test_a_trajectory_that_the_gate_allows_is_not_changed(
    points: list[tuple[list[float], float, float]],
) -> None:
    robot, place, commands = profile(), HOME, []
    for direction, reach, duration_s in points:
        place = place + reach * duration_s * np.array(direction)
        commands.append(JointCommand(names=ARM_JOINTS, position=place, duration_s=duration_s))
    message = to_joint_trajectory(*commands)
    try:
        check_joints(JointLimit.by_joint(robot), [message], AT_HOME)
    except RefusedError:
        return
    limits = DriverLimiter(robot, MotionRules(reactions={}))
    limits.measure(AT_HOME)
    now_s = 1000.0
    played = limits.admit(commands_from_message(message), now_s)
    for command, asked in zip(played, commands, strict=True):
        assert command.duration_s == pytest.approx(asked.duration_s, abs=1e-8)
        passed = limits.limit(command, now_s)
        assert passed.acted == (), passed.reason
        limits.note_sent(passed.command, now_s)
        now_s += command.duration_s
        limits.measure(JointSample(names=ARM_JOINTS, position=command.position))
