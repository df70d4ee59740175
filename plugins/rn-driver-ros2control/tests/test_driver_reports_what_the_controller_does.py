"""Faults of the controller are states with one clear error; commands are refused until somebody has
looked.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_driver_ros2control.driver import Ros2ControlDriver
from rn_driver_ros2control.link import End
from rn_driver_ros2control.standin import StandInController
from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD
from rn_testing.waiting import wait_until
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    JointCommand,
    NotReadyError,
    RefusedError,
    StateError,
    UnsafeError,
)

BLOCKED = {"path_tolerance": 0.02, "goal_tolerance": 0.02, "goal_time_tolerance_s": 0.2}


def command(step: float = 0.1, duration_s: float = 0.5, **joints: float) -> JointCommand:
    names, position = (*ARM_JOINTS, *joints), [*HOME_RAD[:6], HOME_RAD[6] + step, *joints.values()]
    return JointCommand(names=names, position=np.array(position), duration_s=duration_s)


def fault(driver: Ros2ControlDriver) -> str:
    return str(driver.read().detail["fault"])


@pytest.mark.parametrize("mode", ["topic", "action"])
def test_a_blocked_arm_is_a_fault_that_stays(rig, mode):
    driver = rig.driver(mode=mode, **BLOCKED)
    rig.link.controller.blocked = True
    driver.send(command())
    wait_until(lambda: "path tolerance violated" in fault(driver), 10.0)
    rig.link.controller.blocked = False
    with pytest.raises(UnsafeError, match=r"path tolerance violated.*recover_robot"):
        driver.send(command())
    assert "path tolerance violated" in driver.recover()
    with pytest.raises(StateError, match="no fault"):
        driver.recover()
    driver.send(command())
    wait_until(lambda: abs(driver.read().joints.position[6] - HOME_RAD[6] - 0.1) < 0.005, 10.0)
    assert fault(driver) == ""


def test_a_fault_is_not_forgotten_while_the_controller_is_not_active(rig):
    driver = rig.driver(mode="action", **BLOCKED)
    driver.send(command())
    rig.link.controller.active = False
    rig.link.end_from_outside(End.ABORTED, "deactivated")
    wait_until(lambda: driver.read().detail["controller"] == "inactive", 10.0)
    with pytest.raises(RefusedError, match="switch_controllers --activate"):
        driver.recover()
    assert "aborted" in fault(driver)
    rig.link.controller.active = True
    wait_until(lambda: driver.read().detail["controller"] == "active", 10.0)
    assert "aborted" in driver.recover()


def test_in_mode_topic_a_violated_path_makes_the_driver_hold(rig):
    driver = rig.driver(mode="topic", **BLOCKED)
    rig.link.controller.blocked = True
    driver.send(command())
    wait_until(lambda: fault(driver), 10.0)
    assert len(rig.link.sent) == 2
    assert rig.link.sent[-1].points[0].velocities.tolist() == [0.0] * 7


@pytest.mark.parametrize("mode", ["topic", "action"])
def test_an_end_that_is_not_reached_is_a_fault(rig, mode):
    driver = rig.driver(mode=mode, goal_tolerance=0.02, goal_time_tolerance_s=0.2)
    rig.link.controller.blocked = True
    driver.send(command(duration_s=0.1))
    wait_until(lambda: "goal tolerance violated" in fault(driver), 10.0)


def test_commands_may_go_on_after_a_fault_where_the_options_say_so(rig):
    driver = rig.driver(mode="action", resume_after_fault=True, **BLOCKED)
    rig.link.controller.blocked = True
    driver.send(command())
    wait_until(lambda: fault(driver), 10.0)
    driver.send(command(step=0.0))
    assert fault(driver) == ""


def test_replacing_its_own_goal_is_no_fault(rig):
    driver = rig.driver(mode="action")
    for step in (0.1, 0.05, 0.0):
        driver.send(command(step))
    wait_until(lambda: driver.read().detail["goal"].startswith("succeeded"), 10.0)
    assert fault(driver) == ""


@pytest.mark.parametrize(
    ("end", "text", "word"),
    [
        (
            End.ABORTED,
            "Current goal preempted by new incoming action.",
            "another client sends goals",
        ),
        (End.ABORTED, "Current goal cancelled during deactivate transition.", "deactivate"),
        (End.CANCELLED, "", "another client has cancelled"),
    ],
)
def test_a_goal_that_others_end_is_a_fault(rig, end, text, word):
    driver = rig.driver(mode="action")
    driver.send(command(duration_s=30.0))
    rig.link.end_from_outside(end, text)
    assert word in fault(driver)
    with pytest.raises(UnsafeError, match=word):
        driver.send(command())


@pytest.mark.parametrize("mode", ["topic", "action"])
def test_an_inactive_controller_is_named_with_the_command_that_activates_it(rig, mode):
    driver = rig.driver(mode=mode, state_timeout_s=0.2)
    rig.link.controller.active = False
    wait_until(lambda: driver.read().detail["controller"] == "inactive", 10.0)
    with pytest.raises(
        NotReadyError,
        match=r"not active.*switch_controllers --activate joint_trajectory_controller",
    ):
        driver.send(command())
    assert rig.link.sent == []


def test_open_refuses_a_controller_that_is_not_active(rig):
    rig.prepare = lambda link: setattr(link.controller, "active", False)
    with pytest.raises(NotReadyError, match="not active"):
        rig.driver(connect_timeout_s=0.2)


def test_open_refuses_a_controller_of_other_joints(rig):
    rig.prepare = lambda link: setattr(
        link, "controller", StandInController((*ARM_JOINTS[:6], "spare"), np.zeros(7))
    )
    with pytest.raises(NotReadyError, match="does not tell fr3_joint7"):
        rig.driver(connect_timeout_s=0.2)
    more = (*ARM_JOINTS, "spare")
    rig.prepare = lambda link: setattr(
        link, "controller", StandInController(more, np.array([*HOME_RAD, 0.0]))
    )
    with pytest.raises(ConfigurationError, match=r"moves .*spare"):
        rig.driver()


def test_a_controller_that_has_gone_is_an_error(rig):
    driver = rig.driver()
    rig.link.is_there = False
    with pytest.raises(NotReadyError, match="has gone"):
        driver.send(command())


def test_a_rejected_goal_is_an_error_and_no_fault(rig):
    driver = rig.driver(mode="action")
    rig.link.controller.refusal = lambda trajectory, now_s: "Joints don't match."
    with pytest.raises(
        InvalidInputError, match=r"did not take a goal: rejected.*Joints don't match"
    ):
        driver.send(command())
    assert fault(driver) == ""


def test_a_goal_without_answer_is_an_error(rig):
    driver = rig.driver(mode="action", goal_timeout_s=0.1)
    rig.link.answers = False
    with pytest.raises(NotReadyError, match="did not answer"):
        driver.send(command())


def test_joint_states_that_cease_are_an_error_of_read_send_and_hold(rig):
    driver = rig.driver(state_timeout_s=0.1)
    rig.link.tells = False
    wait_until(lambda: time.monotonic() - rig.link.joints()[ARM_JOINTS[0]].received_s > 0.15, 10.0)
    for use in (driver.read, lambda: driver.send(command()), driver.hold):
        with pytest.raises(NotReadyError, match=r"silent|ceased"):
            use()


def test_states_that_cease_are_told_with_the_state_of_the_controller_and_its_fault(rig):
    driver = rig.driver(mode="action", state_timeout_s=0.1, **BLOCKED)
    rig.link.controller.blocked = True
    driver.send(command())
    wait_until(lambda: "path tolerance violated" in fault(driver), 10.0)
    rig.link.tells = False
    wait_until(lambda: time.monotonic() - rig.link.joints()[ARM_JOINTS[0]].received_s > 0.15, 10.0)
    with pytest.raises(
        NotReadyError, match=r"silent.*/joint_trajectory_controller last reported .*path tolerance"
    ):
        driver.read()


def test_a_hold_brakes_evenly_within_the_acceleration_limits(rig):
    driver = rig.driver(interpolation="cubic")
    driver.send(command(step=1.0, duration_s=1.0))
    wait_until(lambda: abs(driver.read().joints.velocity[6]) > 0.8, 10.0)
    driver.hold()
    point = rig.link.sent[-1].points[0]
    duration_s = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
    assert point.velocities.tolist() == [0.0] * 7
    assert duration_s >= 0.8 / 10.0  # from over 0.8 rad/s with less than 10 rad/s^2
    wait_until(lambda: abs(driver.read().joints.position[6] - point.positions[6]) < 1e-3, 10.0)


def test_a_gripper_that_is_not_driven_is_left_out_and_told(rig):
    driver = rig.driver()
    sent = driver.send(command(fr3_finger_joint1=0.01))
    assert sent.names == ARM_JOINTS
    assert rig.link.gripper_goals == []
    told = driver.read().detail
    assert "not driven" in told["gripper"]
    assert told["no_gripper"] == "true", "tools move the arm without it"


def test_a_gripper_command_that_repeats_itself_is_one_goal(rig):
    driver = rig.driver(gripper="gripper-command")
    for position in (0.02, 0.02, 0.0201, 0.0, 0.0):
        driver.send(command(fr3_finger_joint1=position))
    assert rig.link.gripper_goals == pytest.approx([0.02, 0.0])


def test_another_publisher_of_the_robots_own_joint_states_is_refused(rig):
    from sensor_msgs.msg import JointState

    from rn_driver_ros2control.options import Ros2ControlOptions
    from rn_robot_fr3.profile import profile
    from rn_testing.fakes import MemoryTopics

    topics = MemoryTopics()
    topics.advertise("joint_states", JointState)
    driver = Ros2ControlDriver(Ros2ControlOptions(), profile(), topics)
    with pytest.raises(ConfigurationError, match=r"already publishes `joint_states`.*namespace"):
        driver.open()
    with pytest.raises(StateError):
        driver.read()
