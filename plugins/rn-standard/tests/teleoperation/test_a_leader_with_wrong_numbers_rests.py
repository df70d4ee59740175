"""A leader that reports numbers that are not finite leads neither arm nor gripper."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from rn_standard.teleoperation.contract_cases import Loopback
from rn_standard.teleoperation.samples import LeadSample
from rn_standard.teleoperation.session import LeadSession, LeadSpeeds
from rn_standard.teleoperation.topic_sources import JointTopic
from rn_testing.fakes import gantry_profile
from roboneuron import UnsafeError

PROFILE = gantry_profile()
ARM = PROFILE.arm_joints
assert PROFILE.gripper is not None
FINGER = PROFILE.gripper.joint


def led_by(joint: str, position: float) -> LeadSample:
    """The sample of a leader whose joints are 0 but for one."""
    world, source = Loopback(), JointTopic(None, PROFILE)
    source.open(world)
    names = [*ARM, FINGER]
    positions = np.where(np.array(names) == joint, position, 0.0)
    world.publish("/leader/switch", Bool(data=True))
    world.publish("/leader/joint_states", JointState(name=names, position=positions.tolist()))
    sample = source.read(0.0)
    source.close()
    assert sample is not None
    return sample


@pytest.mark.parametrize("joint", [FINGER, ARM[0]])
@pytest.mark.parametrize("position", [math.nan, math.inf, -math.inf])
def test_a_position_that_is_not_finite_is_refused(joint: str, position: float) -> None:
    sample = led_by(joint, position)
    session = LeadSession("one", "person", PROFILE, LeadSpeeds(), sample.at_s, scale=1.0)
    with pytest.raises(UnsafeError, match="not finite; the arm rests"):
        session.take(sample, sample.at_s)


@pytest.mark.parametrize(("position", "opening"), [(-1e3, 0.0), (1e3, 1.0)])
def test_a_gripper_beyond_its_range_is_as_far_as_it_goes(position: float, opening: float) -> None:
    assert led_by(FINGER, position).gripper_open == opening
