"""Every reader of joint states and poses leaves out the same messages and reads the same values."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping

import pytest
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState

from rn_driver_ros2control.link import measured_joints
from rn_standard.teleoperation.contract_cases import Loopback
from rn_standard.teleoperation.topic_sources import JointTopic
from rn_testing.fakes import gantry_profile
from rn_view.sources.measured_topics import MeasuredTopics
from roboneuron import InvalidInputError, joints_from_message, pose_from_message
from roboneuron.modules.inference.inputs import NewestInputs
from roboneuron.modules.status import StatusWriter

pytestmark = pytest.mark.ros
PROFILE = gantry_profile()
NAMES = list(PROFILE.arm_joints)
assert PROFILE.gripper is not None
ALL = [*NAMES, PROFILE.gripper.joint]
"""All that a reader may ask for."""
Read = Callable[[JointState], Mapping[str, float] | None]
"""Positions by name; None for a message that is left out."""


class _Source:
    """What the live view asks of a robot's source."""

    playback = None

    def __init__(self) -> None:
        self.callbacks: dict[str, Callable[[object], None]] = {}

    def config(self) -> object:
        from roboneuron.config import parse_config

        return parse_config(
            '[robot]\nname = "gantry"\n[control]\ncontroller = "none"\ncommand = "joint_state"\n'
        )

    def subscribe(
        self, message_type: type, topic: str, callback: Callable[[object], None]
    ) -> Callable[[], None]:
        self.callbacks[topic] = callback
        return lambda: None


def contract(message: JointState) -> Mapping[str, float] | None:
    try:
        joints = joints_from_message(message)
    except InvalidInputError:
        return None
    return dict(zip(joints.names, joints.position.tolist(), strict=True))


def ros2_control(message: JointState) -> Mapping[str, float] | None:
    try:
        joints = measured_joints(message, 1.0, {})
    except InvalidInputError:
        return None
    return {name: joint.position for name, joint in joints.items()}


def leader(message: JointState) -> Mapping[str, float] | None:
    world, source = Loopback(), JointTopic(None, PROFILE)
    source.open(world)
    world.publish("/leader/joint_states", message)
    try:
        sample = source.read(0.0)
    except InvalidInputError:
        return None
    finally:
        source.close()
    assert sample is not None
    assert sample.positions is not None
    return sample.positions


def view(topic: str) -> Read:
    def read(message: JointState) -> Mapping[str, float] | None:
        source = _Source()
        measured = MeasuredTopics(source, PROFILE)  # type: ignore[arg-type]
        measured.open()
        source.callbacks[topic](message)
        found = measured.joints if topic == "joint_states" else measured.commanded
        return found or None

    return read


READERS: dict[str, Read] = {
    "contract": contract,
    "driver of ros2_control": ros2_control,
    "leader": leader,
    "view": view("joint_states"),
    "view of commands": view("joint_command"),
}


def state(names: list[str], positions: list[float], velocities: list[float]) -> JointState:
    message = JointState(name=names, position=positions, velocity=velocities)
    message.header.stamp.sec = int(time.time())
    return message


COUNT = len(ALL)
UNREADABLE = {
    "no positions": (ALL, [], []),
    "fewer positions": (ALL, [0.1] * (COUNT - 1), []),
    "more positions": (ALL, [0.1] * (COUNT + 1), []),
    "a name twice": ([*ALL, ALL[0]], [0.1] * COUNT + [0.2], []),
    "fewer velocities": (ALL, [0.1] * COUNT, [0.0]),
}
READABLE = {
    "no velocities": [],
    "velocities": [0.5] * COUNT,
    "no velocity interface": [math.nan] * COUNT,
    "one without a velocity interface": [0.5] * (COUNT - 1) + [math.nan],
}


@pytest.mark.parametrize("kind", UNREADABLE)
@pytest.mark.parametrize("reader", READERS)
def test_a_message_that_does_not_match_itself_is_left_out(reader: str, kind: str) -> None:
    assert READERS[reader](state(*UNREADABLE[kind])) is None


@pytest.mark.parametrize("kind", READABLE)
@pytest.mark.parametrize("reader", READERS)
def test_positions_are_read_whatever_is_told_of_velocities(reader: str, kind: str) -> None:
    positions = [0.1 * (i + 1) for i in range(COUNT)]
    found = READERS[reader](state(ALL, positions, READABLE[kind]))
    assert found is not None
    told = dict(zip(ALL, positions, strict=True))
    assert {name: found[name] for name in NAMES} == {name: told[name] for name in NAMES}


@pytest.mark.parametrize("kind", READABLE)
def test_a_velocity_that_is_not_measured_is_none(kind: str) -> None:
    """The joint_state_broadcaster writes NaN for a joint without a velocity interface."""
    velocities = READABLE[kind] or [math.nan] * COUNT
    joints = measured_joints(state(ALL, [0.1] * COUNT, READABLE[kind]), 1.0, {})
    expected = [None if math.isnan(one) else one for one in velocities]
    assert [joints[name].velocity for name in ALL] == expected
    read = joints_from_message(state(ALL, [0.1] * COUNT, READABLE[kind]))
    assert (read.velocity is None) == all(map(math.isnan, velocities))


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("place", ["position.x", "position.z", "orientation.w"])
def test_a_pose_that_is_not_finite_is_counted_and_the_last_one_kept(
    place: str, value: float
) -> None:
    good, bad = PoseStamped(), PoseStamped()
    part, _, axis = place.partition(".")
    setattr(getattr(bad.pose, part), axis, value)
    with pytest.raises(InvalidInputError):
        pose_from_message(bad)
    status = StatusWriter("arm/inference")
    inputs = NewestInputs(
        cameras={},
        optional=frozenset(),
        needs_state=True,
        gripper=None,
        max_age_s=5.0,
        status=status,
        now_ns=time.time_ns,
        take_images=lambda timeout_s: None,
    )
    for message in (good, bad):
        inputs.on_ee_pose(message)
        inputs.on_arm_pose("left", message)
    assert status.report().dropped_by == {"bad_pose": 2}
