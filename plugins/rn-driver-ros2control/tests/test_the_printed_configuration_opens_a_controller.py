"""The page about ros2_control prints a configuration for franka_ros2: the driver opens a controller
with its names, in another process.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_robot_fr3.profile import profile
from rn_testing.domain import free_ros_domain

PAGE = Path(__file__).parents[3] / "docs/ros2-control.md"


DRIVER = """
import faulthandler, json, os, signal, sys, time

faulthandler.enable()
from rn_driver_ros2control.driver import Ros2ControlDriver
from rn_driver_ros2control.options import Ros2ControlOptions
from rn_robot_fr3.profile import profile
from rn_testing.fakes import MemoryTopics

options = Ros2ControlOptions.model_validate_json(sys.argv[1])
driver = Ros2ControlDriver(options, profile(), MemoryTopics())
driver.open()
try:
    state = driver.read()
    told = {"controller": state.detail["controller"], "gripper_open": state.gripper_open}
    os.kill(int(sys.argv[2]), signal.SIGKILL)
    deadline_s = time.monotonic() + 30.0
    # the driver reads on until controller and joint states have been silent for their bound
    while time.monotonic() < deadline_s:
        try:
            driver.read()
        except Exception as error:
            told["last_words"] = str(error)
            break
        time.sleep(0.02)
    print(json.dumps(told))
finally:
    driver.close()
"""
"""Reads until the controller, whose process it kills, has died; prints what the driver says."""


def printed_options() -> dict[str, Any]:
    text = PAGE.read_text()
    block = text[text.index("        [robot]\n") :].split("\n\n    Cameras")[0]
    return dict(tomllib.loads(textwrap.dedent(block))["plugins"]["fr3"])


def arguments() -> list[str]:
    """Options of a stand-in with the names of the configuration."""
    options = printed_options()
    names = ("controller", "joint_states", "gripper_action", "gripper_joint_states")
    named = [word for name in names for word in ("--" + name.replace("_", "-"), options[name])]
    home = ("0", "-0.785", "0", "-2.356", "0", "1.571", "0.785")
    joints = ("--joints", *profile().arm_joints, "--start", *home)
    return [*named, *joints, "--gripper-joint", "fr3_finger_joint1"]


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[bytes]]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    environment = dict(os.environ)  # a shell's: without what the server sets for itself
    from roboneuron.ros.environment import prepare_environment

    prepare_environment(tmp_path)
    command = [sys.executable, "-m", "rn_driver_ros2control.standin_node", *arguments()]
    with (tmp_path / "standin.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
    yield process
    process.kill()
    process.wait()


@pytest.mark.ros
def test_the_driver_opens_and_tells_when_the_controller_has_died(stand_in):
    """In a process of its own: closing beside a controller that was killed has crashed in rclpy's
    `destroy_node` twice, which would end all tests of this process.
    """
    options = {**printed_options(), "connect_timeout_s": 60.0}
    words = [sys.executable, "-c", DRIVER, json.dumps(options), str(stand_in.pid)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120.0, check=False)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["controller"] == "active"
    assert told["gripper_open"] == pytest.approx(1.0)
    assert "silent" in told["last_words"]
    assert "/fr3_arm_controller last reported its state" in told["last_words"]
