"""The service of a controller manager, with types that are compiled from definitions of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_driver_ros2control.interfaces import typesupport
from rn_testing.domain import free_ros_domain

DEFINITIONS = {
    "msg/ControllerState.msg": "string name\nstring state\nstring[] claimed_interfaces\n"
    "string[] required_command_interfaces\n",
    "srv/ListControllers.srv": "---\ncontroller_manager_msgs/ControllerState[] controller\n",
}
"""The fields that the driver reads."""
PROGRAM = """
import json, sys, time, rclpy
from controller_manager_msgs.msg import ControllerState
from controller_manager_msgs.srv import ListControllers
from rclpy.executors import SingleThreadedExecutor
from rn_driver_ros2control.manager import ManagerWatch
from rn_driver_ros2control.options import Ros2ControlOptions

rclpy.init()
manager, asker = rclpy.create_node("controller_manager"), rclpy.create_node("asker")
own = ["j1/position"]
rows = [
    ControllerState(name="arm", state="inactive", required_command_interfaces=own),
    ControllerState(name="other", state="active", claimed_interfaces=own),
]

def answer(request, response):
    response.controller = rows
    return response

manager.create_service(ListControllers, "/controller_manager/list_controllers", answer)
watch = ManagerWatch(Ros2ControlOptions(controller="/arm"))
watch.join(asker)
executor = SingleThreadedExecutor()
executor.add_node(manager)
executor.add_node(asker)
deadline_s = time.monotonic() + 60.0
while watch.listed is None and time.monotonic() < deadline_s:
    executor.spin_once(timeout_sec=0.1)
found = watch.listed
with open(sys.argv[1], "w") as file:
    json.dump(None if found is None else [found.state, *found.claimed_by], file)
"""


@pytest.mark.ros
@pytest.mark.slow
def test_a_manager_says_which_controller_has_claimed_the_joints(tmp_path: Path) -> None:
    folder = tmp_path / "controller_manager_msgs"
    for name, text in DEFINITIONS.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    built = tmp_path / "built"
    typesupport.build(folder, built)
    environment = {
        **os.environ,
        "PYTHONPATH": str(built),
        "LD_LIBRARY_PATH": f"{built / 'lib'}:{os.environ.get('LD_LIBRARY_PATH', '')}",
        "AMENT_PREFIX_PATH": os.pathsep.join((str(built), sys.prefix)),
        "ROS_DOMAIN_ID": str(free_ros_domain()),
    }
    answer = tmp_path / "answer.json"
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(answer)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(answer.read_text(encoding="utf-8")) == ["inactive", "other"]
