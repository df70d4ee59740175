"""The robot and perception modules on a ROS graph, judged by their topics and by their driver's
calls. What the robot makes of commands is shown on a test clock
(test_commands_reach_the_driver_in_their_time.py and its neighbours).
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from robot_cell import LOOSE
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from rn_testing.waiting import holds_within
from roboneuron.contract import JointCommand
from roboneuron.ros.messages import to_joint_trajectory
from roboneuron.ros.qos import LATCHED

pytestmark = pytest.mark.ros


def command(first: float, duration_s: float = 0.05) -> JointTrajectory:
    return to_joint_trajectory(
        JointCommand(names=("a", "b"), position=np.array([first, 0.0]), duration_s=duration_s)
    )


@pytest.fixture
def robot(world: Any) -> Any:
    return world.start("robot", replace={'name = "pair"': LOOSE})


def test_it_measures_follows_a_command_and_holds_once_when_they_cease(
    world: Any, robot: Any, status_of: Any
) -> None:
    received = world.listen(JointState, "joint_states")
    driver = robot.module.driver
    assert holds_within(lambda: len(received) > 20)
    assert list(received[-1].name) == ["a", "b"]
    assert holds_within(lambda: status_of(robot).get("detail.mood") == "fine")
    world.publisher(JointTrajectory, "joint_trajectory").publish(command(0.3))
    assert holds_within(lambda: driver.position[0] == 0.3)
    assert holds_within(lambda: driver.holds == 1, 2.0)
    assert not holds_within(lambda: driver.holds > 1, 0.5)
    assert world.run(robot.trigger_deactivate) is TransitionCallbackReturn.SUCCESS
    assert driver.holds == 2


def test_trajectory_is_played_point_by_point_and_replaced_by_a_newer_one(
    world: Any,
    robot: Any,
) -> None:
    publisher = world.publisher(JointTrajectory, "joint_trajectory")
    message = command(0.1, 0.2)
    for index in range(1, 5):
        point = JointTrajectoryPoint(positions=[0.1 + index / 10, 0.0])
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(
            (index + 1) * 200_000_000, 10**9
        )
        message.points.append(point)
    publisher.publish(message)
    driver = robot.module.driver
    assert holds_within(lambda: len(driver.sent) == 2)
    publisher.publish(command(-0.9))
    assert holds_within(lambda: driver.position[0] == -0.9, 0.15)
    assert not holds_within(lambda: len(driver.sent) > 3, 0.4)


def test_emergency_stop_holds_the_driver_and_refuses_commands(
    world: Any, robot: Any, status_of: Any
) -> None:
    publisher = world.publisher(JointTrajectory, "joint_trajectory")
    world.node.create_publisher(Bool, "emergency_stop", LATCHED).publish(Bool(data=True))
    driver = robot.module.driver
    assert holds_within(lambda: driver.holds == 1)
    publisher.publish(command(0.1))
    assert holds_within(lambda: status_of(robot).get("dropped.emergency_stop") == "1")
    assert not driver.sent


def long_trajectory(points: int, step_s: float) -> JointTrajectory:
    message = command(0.1, step_s)
    for index in range(2, points + 1):
        point = JointTrajectoryPoint(positions=[0.1 * index, 0.0])
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(
            round(index * step_s * 1e9), 10**9
        )
        message.points.append(point)
    return message


def test_a_trajectory_ends_in_a_hold_when_its_server_falls_silent_and_is_not_taken_up_again(
    world: Any, status_of: Any
) -> None:
    robot = world.start(
        "robot",
        replace={
            'name = "pair"': LOOSE,
            "command_timeout_s = 0.3": "command_timeout_s = 5.0\nserver_timeout_s = 0.4",
        },
    )
    driver = robot.module.driver
    publisher = world.publisher(JointTrajectory, "joint_trajectory")
    publisher.publish(long_trajectory(3, 0.15))
    assert holds_within(lambda: len(driver.sent) == 3), (
        "a module without a server has no server to wait for"
    )
    for silences in (1, 2):
        if robot.needs_start:
            world.permit(robot)
        robot.note_beat()
        sent, holds = len(driver.sent), driver.holds
        assert holds_within(lambda: not robot._was_server_silent)
        publisher.publish(long_trajectory(40, 0.1))
        assert holds_within(lambda holds=holds: driver.holds > holds, 2.0), (
            "held though the trajectory lasts 4 s"
        )
        played = len(driver.sent)
        assert sent < played < sent + 20
        publisher.publish(command(0.9))
        assert holds_within(
            lambda n=silences: status_of(robot).get("dropped.server_silent") == str(n)
        )
        assert not holds_within(lambda played=played: len(driver.sent) > played, 0.3)
        assert "the server gave no sign of life" in status_of(robot)["note"]

    def refuses() -> bool:
        robot.note_beat()
        publisher.publish(command(0.5))
        return "dropped.needs_new_start" in status_of(robot)

    played = len(driver.sent)
    assert holds_within(refuses)
    assert len(driver.sent) == played, "a server that lives again starts nothing"
    world.permit(robot)
    robot.note_beat()
    publisher.publish(command(0.5))
    assert holds_within(lambda: driver.position[0] == 0.5)


def test_a_driver_s_own_topics_are_closed_while_the_server_is_silent(world: Any) -> None:
    """A mobile base receives velocities on its own topic."""
    robot = world.start("robot", replace={"command_timeout_s = 0.3": "server_timeout_s = 0.2"})
    heard: list[bool] = []
    world.run(
        lambda: robot.module._topics.subscribe(
            "cmd", Bool, lambda message: heard.append(message.data)
        )
    )
    publisher = world.publisher(Bool, "cmd")
    publisher.publish(Bool(data=True))
    assert holds_within(lambda: heard == [True])
    robot.note_beat()
    assert holds_within(lambda: robot.module.driver.holds == 1)
    publisher.publish(Bool(data=True))
    assert not holds_within(lambda: len(heard) > 1, 0.3)


def test_images_carry_capture_time_frame_and_encoding(world: Any) -> None:
    received = world.listen(Image, "camera/front/image")
    world.start("perception")
    assert holds_within(lambda: len(received) > 2)
    image = received[-1]
    assert (image.encoding, image.width, image.height, image.step) == ("rgb8", 8, 6, 24)
    assert image.header.frame_id == "optical"
    assert abs(time.time() - image.header.stamp.sec) < 5


def test_camera_that_never_delivers_is_an_error_that_says_what_to_do(
    world: Any, status_of: Any
) -> None:
    node = world.start("perception", replace={'source = "noise"': 'source = "silent"'})
    assert status_of(node)["waiting_for"] == "the first image of camera 'front'"
    assert holds_within(lambda: status_of(node)["error_code"] == "not_ready", 6.0)
    assert status_of(node)["message"] == "The camera does not deliver. Is it plugged in?"
    assert status_of(node)["ready"] == "false"


def test_unknown_camera_names_the_choices(world: Any) -> None:
    node = world.module(
        "perception", replace={'source = "noise"': 'source = "noise"\ncameras = ["rear"]'}
    )
    assert world.run(node.trigger_configure) is TransitionCallbackReturn.FAILURE
    assert (
        "'pair' has no camera 'rear'; its cameras are 'front'" in node.status.to_message().message
    )
