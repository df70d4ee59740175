"""The page about ros2_control prints a configuration and a stand-in for it: they are run as they
are printed.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import textwrap
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_driver_ros2control.driver import Ros2ControlDriver
from rn_driver_ros2control.options import Ros2ControlOptions
from rn_driver_ros2control.standin_node import parse
from rn_robot_fr3.profile import profile
from rn_testing.domain import free_ros_domain
from rn_testing.fakes import MemoryTopics

PAGE = Path(__file__).parents[3] / "docs/ros2-control.md"
PROGRAM = "python -m rn_driver_ros2control.standin_node"


def printed_options() -> dict[str, Any]:
    text = PAGE.read_text()
    block = text[text.index("        [robot]\n") :].split("\n\n    Cameras")[0]
    return dict(tomllib.loads(textwrap.dedent(block))["plugins"]["fr3"])


def printed_arguments() -> list[str]:
    text = PAGE.read_text()
    command = text[text.index(PROGRAM) :].split("\n\n")[0]
    return shlex.split(command.replace("\\\n", " "))[3:]


def test_names_of_the_stand_in_are_those_of_the_configuration():
    options, stand_in = printed_options(), vars(parse(printed_arguments()))
    names = ("controller", "joint_states", "gripper_action", "gripper_joint_states")
    assert {name: stand_in[name] for name in names} == {name: options[name] for name in names}
    assert tuple(stand_in["joints"]) == profile().arm_joints


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[bytes]]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    environment = dict(os.environ)  # a shell's: without what the server sets for itself
    from roboneuron.ros.environment import prepare_environment

    prepare_environment(tmp_path)
    command = [sys.executable, *shlex.split(PROGRAM)[1:], *printed_arguments()]
    with (tmp_path / "standin.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
    yield process
    process.kill()
    process.wait()


@pytest.mark.ros
def test_the_driver_opens_and_tells_when_the_controller_has_died(stand_in):
    options = Ros2ControlOptions.model_validate({**printed_options(), "connect_timeout_s": 60.0})
    driver = Ros2ControlDriver(options, profile(), MemoryTopics())
    driver.open()
    try:
        state = driver.read()
        assert state.detail["controller"] == "active"
        assert state.gripper_open == pytest.approx(1.0)
        stand_in.kill()
        assert "/fr3_arm_controller last reported its state" in last_words(driver)
    finally:
        driver.close()


def last_words(driver: Ros2ControlDriver) -> str:
    """What `read` raises once controller and joint states have been silent for their bound."""
    deadline_s = time.monotonic() + 30.0
    while time.monotonic() < deadline_s:
        try:
            driver.read()
        except Exception as error:
            if "silent" in str(error):
                return str(error)
            raise
        time.sleep(0.02)
    raise AssertionError("the driver went on reading the states of a controller that was killed")
