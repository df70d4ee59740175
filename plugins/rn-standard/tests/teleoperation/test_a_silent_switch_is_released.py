"""The switch of a leader arm counts as released when nobody tells any more that it is held, though
the leader's joints still come.
"""

from __future__ import annotations

import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from rn_standard.teleoperation.contract_cases import Loopback
from rn_standard.teleoperation.topic_sources import JointTopic, JointTopicOptions
from rn_testing.fakes import gantry_profile
from rn_testing.waiting import wait_until
from roboneuron import InvalidInputError

PROFILE = gantry_profile()
ARM = list(PROFILE.arm_joints)


class Leader:
    """A leader's joints with a switch."""

    def __init__(self, switch_s: float) -> None:
        self.world = Loopback()
        self.source = JointTopic(JointTopicOptions(switch_s=switch_s), PROFILE)
        self.source.open(self.world)

    def press(self, is_held: bool) -> None:
        self.world.publish("/leader/switch", Bool(data=is_held))

    def is_held(self) -> bool:
        """What a new message of the joints says."""
        joints = JointState(name=ARM, position=[0.0] * len(ARM))
        self.world.publish("/leader/joint_states", joints)
        sample = self.source.read(0.0)
        assert sample is not None
        return sample.is_held


def test_a_switch_that_nobody_repeats_is_released() -> None:
    leader = Leader(switch_s=0.05)
    leader.press(True)
    wait_until(lambda: not leader.is_held(), 5.0)


def test_a_switch_that_is_repeated_stays_held_until_it_is_released() -> None:
    leader = Leader(switch_s=5.0)
    assert not leader.is_held()
    for _ in range(3):
        leader.press(True)
        assert leader.is_held()
    leader.press(False)
    assert not leader.is_held()


@pytest.mark.parametrize("count", [len(ARM) - 1, len(ARM) + 1])
def test_joints_without_their_positions_lead_nothing(count: int) -> None:
    leader = Leader(switch_s=5.0)
    leader.press(True)
    message = JointState(name=ARM, position=[0.0] * count)
    leader.world.publish("/leader/joint_states", message)
    with pytest.raises(InvalidInputError):
        leader.source.read(0.0)
