"""lerobot moves an FR3 behind ros2_control."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from lerobot_lane import PATIENT, Lerobot, Watch, serve

from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT
from rn_robot_fr3.profile import HOME_RAD
from roboneuron.plugins.availability import is_importable

END_S = 300.0
pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.skipif(not is_importable("control_msgs"), reason="control_msgs is not built here")
def test_an_arm_behind_ros2_control_is_teleoperated(
    lerobot: Lerobot, tmp_path: Path, stack: ExitStack
) -> None:
    config = tmp_path / "fr3.toml"
    config.write_text(
        '[robot]\nname = "fr3"\ndriver = "ros2-control"\nnamespace = "roboneuron_fr3"\n'
        '[control]\ncontroller = "urdf"\n'
        '[plugins.fr3]\ncontroller = "/fr3_arm_controller"\n'
        'gripper = "gripper-command"\n',
        encoding="utf-8",
    )
    command = [sys.executable, "-m", "rn_driver_ros2control.standin_node"]
    command += ["--controller", "/fr3_arm_controller", "--joints", *ARM_JOINTS]
    command += ["--start", *map(str, HOME_RAD), "--gripper-joint", FINGER_JOINT]
    log = stack.enter_context((tmp_path / "controller.log").open("wb"))
    controller = stack.enter_context(subprocess.Popen(command, stdout=log, stderr=log))
    stack.callback(controller.terminate)
    watch = Watch("roboneuron_fr3", ARM_JOINTS)
    stack.callback(watch.close)
    lerobot.lead("fr3", "--namespace", "roboneuron_fr3")
    process = lerobot.start(
        "lerobot-teleoperate",
        "--robot.type=roboneuron",
        "--robot.robot=fr3",
        "--robot.namespace=roboneuron_fr3",
        "--robot.perception=false",
        *PATIENT,
        serve(config),
        "--teleop.type=roboneuron",
        "--teleop.robot=fr3",
        "--fps=20",
        "--teleop_time_s=8",
    )
    assert process.wait(END_S) == 0, lerobot.last_line(process)
    travel = np.ptp(watch.since(0.0), axis=0)
    assert travel[0] == pytest.approx(0.5, abs=0.05)
    assert travel[4] == pytest.approx(0.6, abs=0.06)
