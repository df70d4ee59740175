"""Control publishes the pose of each arm on its own topic, and the first one's as the robot's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import loop_plugin
import numpy as np
import pytest
from control_cell import ARM, Cell, MakeHost
from geometry_msgs.msg import PoseStamped
from space_cell import ROWS, VELOCITIES, SpaceCell

from roboneuron.contract import ArmProfile, Hold, JointSample, Pose, RobotProfile
from roboneuron.modules.step_filters import ActionStep, StepFilter
from roboneuron.ros.messages import to_action_message

ARMS = tuple(
    ArmProfile(name=name, joints=(joint,), base_link="base", tcp_link=f"{name}_tcp", gripper=None)
    for name, joint in zip(("left", "right"), ARM, strict=True)
)


class BothArms(loop_plugin.Follower):  # type: ignore[misc]
    """Its TCPs are as far along x as its joints."""

    def poses(self, joints: JointSample) -> tuple[Pose, ...]:
        return tuple(
            Pose(
                position_m=np.array([place, 0.0, 0.0]),
                quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
                stamp_ns=joints.stamp_ns,
            )
            for place in joints.position.tolist()
        )


@pytest.fixture
def of_two_arms(monkeypatch: pytest.MonkeyPatch) -> None:
    one: Callable[[], RobotProfile] = loop_plugin.profile
    monkeypatch.setattr(loop_plugin, "profile", lambda: replace(one(), arms=ARMS))
    monkeypatch.setattr(loop_plugin, "Follower", BothArms)


def test_each_arm_has_a_topic_with_its_measured_pose(
    make_host: MakeHost, of_two_arms: None
) -> None:
    cell = Cell(make_host, replace={'"adder"': '"follower"'})
    topics = {"first": "ee_pose", "left": "left/ee_pose", "right": "right/ee_pose"}
    publishers = {name: cell.host.publishers[topic] for name, topic in topics.items()}
    assert {one.message_type for one in publishers.values()} == {PoseStamped}
    told = {name: one.messages[-1] for name, one in publishers.items()}
    left, right = cell.position.tolist()
    places = {name: message.pose.position.x for name, message in told.items()}
    assert places == {"first": left, "left": left, "right": right}
    base = cell.control.profile.base_link
    assert {message.header.frame_id for message in told.values()} == {base}


def test_a_velocity_that_the_controller_refuses_holds(make_host: MakeHost) -> None:
    cell = SpaceCell(make_host)
    refusal = Hold(code="too_near", reason="An obstacle is 1 mm away.")
    cell.control.controller.execute = lambda *_: refusal  # type: ignore[attr-defined]
    cell.receive(to_action_message(np.array(ROWS[VELOCITIES]), VELOCITIES))
    assert cell.code == "too_near"


def test_a_clock_paces_the_actions_of_control(make_host: MakeHost) -> None:
    """A filter receives the actions, and hands them on when their time has come."""
    pending: list[Callable[[], None]] = []

    class Paced(StepFilter):
        phase = StepFilter.StepPhase.CLOCK

        def act(self, step: ActionStep, proceed: Callable[[ActionStep], None]) -> None:
            pending.append(lambda: proceed(step))

    cell = Cell(make_host)
    cell.control.clock, cell.control.fixed_step_s = (lambda: 7.0), 0.1
    cell.control.filters.add(Paced())
    cell.act(0.01)
    assert cell.commands == []
    pending.pop()()
    assert cell.commands == [[cell.position[0] + 0.01, cell.position[1]]]
    assert cell.control.step_s(1, 1e9) == 0.1
