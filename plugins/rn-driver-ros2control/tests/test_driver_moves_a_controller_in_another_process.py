"""The driver with real ROS 2 between it and the stand-in controller, which is a process of its
own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_driver_ros2control.driver import Ros2ControlDriver
from rn_driver_ros2control.options import Ros2ControlOptions
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_testing.domain import free_ros_domain
from rn_testing.fakes import MemoryTopics
from rn_testing.waiting import wait_until
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    JointCommand,
    NotReadyError,
    UnsafeError,
)

pytestmark = pytest.mark.ros
ARM = "/fr3_arm_controller"
BOTH_MODES = pytest.mark.parametrize(
    "mode", ["topic", pytest.param("action", marks=pytest.mark.exhaustive)]
)


class Bench:
    """A controller process and drivers on a ROS domain of their own."""

    def __init__(self, folder: Path) -> None:
        os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
        from roboneuron.ros.environment import prepare_environment

        prepare_environment(folder)
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []
        self._drivers: list[Ros2ControlDriver] = []

    def controller(self, *arguments: str) -> subprocess.Popen[bytes]:
        command = [
            sys.executable,
            "-m",
            "rn_driver_ros2control.standin_node",
            "--controller",
            ARM,
            "--joints",
        ]
        command += [
            *ARM_JOINTS,
            "--start",
            *(str(value) for value in HOME_RAD),
            "--gripper-joint",
            FINGER_JOINT,
        ]
        with (self._folder / "controller.log").open("wb") as log:
            process = subprocess.Popen([*command, *arguments], stdout=log, stderr=log)
        self._processes.append(process)
        return process

    def driver(self, **options: object) -> Ros2ControlDriver:
        chosen = {
            "controller": ARM,
            "connect_timeout_s": 60.0,
            "goal_timeout_s": 10.0,
            "state_timeout_s": 10.0,
        }
        driver = Ros2ControlDriver(
            Ros2ControlOptions.model_validate({**chosen, **options}), profile(), MemoryTopics()
        )
        driver.open()
        self._drivers.append(driver)
        return driver

    def ask(self, service: str, value: bool) -> None:
        """Call a SetBool service of the controller from a node of the test."""
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions
        from std_srvs.srv import SetBool

        context = rclpy.Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("asker", context=context)
        client: Any = node.create_client(SetBool, f"{ARM}/{service}")
        assert client.wait_for_service(timeout_sec=30.0)
        executor = SingleThreadedExecutor(context=context)
        future = client.call_async(SetBool.Request(data=value))
        executor.add_node(node)
        executor.spin_until_future_complete(future, timeout_sec=30.0)
        assert future.result().success
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)

    def close(self) -> None:
        for driver in self._drivers:
            driver.close()
        for process in self._processes:
            process.terminate()
            process.wait(timeout=20)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("ROS_DOMAIN_ID", os.environ.get("ROS_DOMAIN_ID", "0"))
    made = Bench(tmp_path)
    yield made
    made.close()


def command(step: float = 0.2, duration_s: float = 0.5, **joints: float) -> JointCommand:
    position = [*HOME_RAD[:6], HOME_RAD[6] + step, *joints.values()]
    return JointCommand(
        names=(*ARM_JOINTS, *joints), position=np.array(position), duration_s=duration_s
    )


def last_joint(driver: Ros2ControlDriver) -> float:
    return float(driver.read().joints.position[6]) - HOME_RAD[6]


def detail(driver: Ros2ControlDriver, name: str) -> str:
    return str(driver.read().detail[name])


@BOTH_MODES
def test_targets_are_reached_replaced_and_held(bench, mode):
    bench.controller()
    driver = bench.driver(mode=mode, gripper="gripper-command")
    assert detail(driver, "controller") == "active"
    driver.send(command(0.2, **{FINGER_JOINT: 0.01}))
    wait_until(lambda: abs(last_joint(driver) - 0.2) < 1e-3, 30.0)
    wait_until(lambda: detail(driver, "gripper") == "reached", 30.0)
    assert driver.read().gripper_open == pytest.approx(0.25, abs=0.01)
    driver.send(command(1.2, 20.0))
    driver.send(command(0.0, 0.3))
    wait_until(lambda: abs(last_joint(driver)) < 1e-3, 30.0)
    driver.send(command(1.2, 20.0))
    wait_until(lambda: last_joint(driver) > 0.02, 30.0)
    driver.hold()
    wait_until(lambda: abs(driver.read().joints.velocity[6]) < 1e-6, 30.0)
    rested = last_joint(driver)
    time.sleep(0.5)
    assert last_joint(driver) == pytest.approx(rested, abs=1e-4)
    assert rested < 1.0
    assert detail(driver, "fault") == ""
    if mode == "action":
        wait_until(lambda: detail(driver, "goal").startswith("succeeded"), 30.0)


def test_a_forward_controller_gets_positions_in_its_order_and_a_gripper_says_what_it_meets(bench):
    bench.controller(
        *("--type", "forward-position", "--joints", *ARM_JOINTS[::-1]),
        *("--start", *(str(value) for value in HOME_RAD[::-1])),
        *("--object", "0.02", "--gripper-type", "parallel-gripper-command"),
    )
    driver = bench.driver(controller_type="forward-position", gripper="parallel-gripper-command")
    driver.send(command(0.2, **{FINGER_JOINT: 0.0}))
    expected = [*HOME_RAD[:6], HOME_RAD[6] + 0.2]
    wait_until(lambda: np.allclose(driver.read().joints.position[:7], expected, atol=1e-3), 30.0)
    wait_until(lambda: detail(driver, "gripper").startswith("stalled"), 30.0)
    assert driver.read().gripper_open == pytest.approx(0.5, abs=0.01)


@pytest.mark.exhaustive
def test_a_controller_that_forwards_velocities_is_refused(bench):
    bench.controller("--type", "forward-position", "--interface", "velocity")
    with pytest.raises(ConfigurationError, match="velocity"):
        bench.driver(controller_type="forward-position")


@pytest.mark.exhaustive
def test_a_goal_that_is_lost_is_a_fault(bench):
    bench.controller("--lose-goals")
    driver = bench.driver(mode="action", goal_time_tolerance_s=0.2, goal_timeout_s=5.0)
    driver.send(command(0.1))
    wait_until(lambda: "lost" in detail(driver, "fault"), 60.0)


@pytest.mark.exhaustive
def test_goals_that_arm_and_gripper_refuse_are_told(bench):
    bench.controller("--refuse-goals")
    driver = bench.driver(mode="action", gripper="gripper-command")
    with pytest.raises(InvalidInputError, match="rejected"):
        driver.send(command(0.1))
    driver.send(JointCommand(names=(FINGER_JOINT,), position=np.array([0.0]), duration_s=0.5))
    wait_until(lambda: "rejected" in detail(driver, "gripper"), 30.0)


def test_violated_tolerances_of_a_goal_are_a_fault_that_stays(bench):
    bench.controller()
    driver = bench.driver(
        mode="action", path_tolerance=0.05, goal_tolerance=0.05, goal_time_tolerance_s=0.5
    )
    bench.ask("block", True)
    driver.send(command(0.5, 2.0))
    wait_until(lambda: "path tolerance violated" in detail(driver, "fault"), 30.0)
    with pytest.raises(UnsafeError, match="path tolerance"):
        driver.send(command())
    bench.ask("block", False)
    driver.recover()
    driver.send(command(0.1))
    wait_until(lambda: abs(last_joint(driver) - 0.1) < 1e-3, 30.0)


def test_another_client_that_takes_the_controller_is_a_fault(bench):
    bench.controller()
    first, second = bench.driver(mode="action"), bench.driver(mode="action")
    first.send(command(1.0, 30.0))
    second.send(command(0.0, 0.3))
    wait_until(lambda: "another client" in detail(first, "fault"), 30.0)
    assert detail(second, "fault") == ""


@BOTH_MODES
def test_deactivation_and_death_of_the_controller_are_named(bench, mode):
    process = bench.controller()
    driver = bench.driver(mode=mode, state_timeout_s=1.0)
    bench.ask("activate", False)
    wait_until(lambda: detail(driver, "controller") == "inactive", 30.0)
    with pytest.raises(NotReadyError, match="not active"):
        driver.send(command())
    bench.ask("activate", True)
    wait_until(lambda: detail(driver, "controller") == "active", 30.0)
    driver.send(command(0.1))
    wait_until(lambda: abs(last_joint(driver) - 0.1) < 1e-3, 30.0)
    process.kill()
    process.wait()
    time.sleep(1.2)
    with pytest.raises(NotReadyError, match="silent"):
        driver.read()
    with pytest.raises(NotReadyError):
        driver.send(command())


def test_a_goal_for_an_inactive_controller_is_rejected_where_nothing_watches_it(bench):
    bench.controller("--inactive")
    driver = bench.driver(mode="action", watch_controller=False)
    with pytest.raises(InvalidInputError, match="rejected"):
        driver.send(command())


def test_without_a_controller_open_says_what_is_missing(bench):
    with pytest.raises(
        NotReadyError, match=r"nobody publishes joint states on /joint_states.*list_controllers"
    ):
        bench.driver(connect_timeout_s=0.5)
    bench.controller("--inactive")
    with pytest.raises(NotReadyError, match="not active"):
        bench.driver(connect_timeout_s=6.0)
    with pytest.raises(NotReadyError, match="no controller /other"):
        bench.driver(controller="/other", connect_timeout_s=3.0)


def test_a_controller_that_answers_at_once_is_heard(bench, monkeypatch):
    """rclpy notes what it waits for only after it has sent: an answer that is quicker is lost,
    unless the thread that reads answers is the one that sends.
    """
    from rclpy.action import ActionClient

    send = ActionClient.send_goal_async

    def send_slowly(client, *arguments, **options):
        note = client._client_handle.send_goal_request

        class Sender:
            def __getattr__(self, name):
                return getattr(handle, name)

            def send_goal_request(self, request):
                number = note(request)
                time.sleep(0.3)  # the answer is there before the number is noted
                return number

        handle = client._client_handle
        client._client_handle = Sender()
        try:
            return send(client, *arguments, **options)
        finally:
            client._client_handle = handle

    bench.controller()
    driver = bench.driver(mode="action")
    monkeypatch.setattr(ActionClient, "send_goal_async", send_slowly)
    position = np.array([*HOME_RAD[:6], HOME_RAD[6] + 0.1])
    driver.send(JointCommand(names=ARM_JOINTS, position=position, duration_s=0.5))
    wait_until(lambda: abs(driver.read().joints.position[6] - position[6]) < 0.005, 30.0)
    wait_until(lambda: detail(driver, "goal") != "executing", 30.0)
    assert detail(driver, "fault") == ""
