"""control_msgs is built from its definitions, serialises, is found by its definitions, and fails
with what to do.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("control_msgs", reason="it is not built here (it needs a C++ compiler)")

from rn_driver_ros2control.interfaces import typesupport

ROOT = Path(__file__).parents[2]
DEFINITIONS = ROOT / "control_msgs"


@pytest.mark.parametrize(
    ("files", "found"),
    [
        (("local_setup.bash", "share/control_msgs/package.xml"), True),
        (("local_setup.bash", "share/std_msgs/package.xml"), False),
        (("share/control_msgs/package.xml",), False),  # an environment with the wheel of this
        ((), False),
    ],
)
def test_types_of_a_sourced_ros_are_used_instead_of_built_ones(tmp_path, monkeypatch, files, found):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'other'}{os.pathsep}{tmp_path}")
    assert typesupport.is_sourced("control_msgs") is found
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    assert not typesupport.is_sourced("control_msgs")


def test_every_definition_has_a_type_of_its_name():
    import importlib

    for name in typesupport.definitions(DEFINITIONS):
        kind, _, file = name.partition("/")
        assert hasattr(importlib.import_module(f"control_msgs.{kind}"), file.partition(".")[0]), (
            name
        )


def test_a_controller_state_survives_serialisation():
    from control_msgs.msg import JointTrajectoryControllerState
    from rclpy.serialization import deserialize_message, serialize_message

    state = JointTrajectoryControllerState(joint_names=["a", "b"], speed_scaling_factor=0.5)
    state.error.positions = [0.25, -0.5]
    state.reference.time_from_start.sec = 3
    assert deserialize_message(serialize_message(state), JointTrajectoryControllerState) == state


def test_an_action_has_goal_result_and_codes():
    from control_msgs.action import FollowJointTrajectory
    from control_msgs.msg import JointTolerance

    goal = FollowJointTrajectory.Goal(path_tolerance=[JointTolerance(name="a", position=0.1)])
    assert goal.path_tolerance[0].position == 0.1
    assert FollowJointTrajectory.Result.PATH_TOLERANCE_VIOLATED == -4
    assert FollowJointTrajectory.Result.GOAL_TOLERANCE_VIOLATED == -5


def test_interfaces_are_found_in_the_ament_index():
    index = Path(sys.prefix) / "share/ament_index/resource_index/rosidl_interfaces/control_msgs"
    listed = index.read_text(encoding="utf-8").split("\n")
    assert {
        "action/FollowJointTrajectory.idl",
        "msg/JointTolerance.json",
        "msg/JointTolerance.msg",
    } <= set(listed)
    assert all((Path(sys.prefix) / "share/control_msgs" / name).is_file() for name in listed)


@pytest.mark.exhaustive
def test_another_package_is_built_with_the_same_command(tmp_path):
    folder = tmp_path / "probe_msgs" / "msg"
    folder.mkdir(parents=True)
    (folder / "Reading.msg").write_text(
        "std_msgs/Header header\nfloat64[3] force\nstring<=8 unit N\n"
    )
    command = [
        sys.executable,
        "-m",
        "rn_driver_ros2control.interfaces.typesupport",
        str(folder.parent),
        str(tmp_path / "out"),
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    script = (
        "from probe_msgs.msg import Reading; from rclpy.serialization import serialize_message as "
        "s,"
        " deserialize_message as d; r = Reading(force=[1.0, 2.0, 3.0]);"
        " assert d(s(r), Reading) == r and r.unit == 'N'"
    )
    libraries = f"{tmp_path / 'out' / 'lib'}:{os.environ.get('LD_LIBRARY_PATH', '')}"
    environment = {**os.environ, "LD_LIBRARY_PATH": libraries}
    subprocess.run(
        [sys.executable, "-c", script],
        check=True,
        cwd=tmp_path / "out",
        timeout=60,
        env=environment,
    )


def test_without_a_compiler_it_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(typesupport.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        typesupport.BuildError, match=r"No C\+\+ compiler .*apt-get install g\+\+.* ziglang"
    ):
        typesupport.build(DEFINITIONS, tmp_path / "out")


def test_a_compiler_that_does_not_exist_is_named(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler -O3")
    with pytest.raises(typesupport.BuildError, match="no-such-compiler"):
        typesupport.find_compiler("control_msgs")


def test_a_broken_definition_fails_with_what_the_generator_said(tmp_path):
    shutil.copytree(DEFINITIONS, tmp_path / "control_msgs")
    (tmp_path / "control_msgs" / "msg" / "JointTolerance.msg").write_text("no_such_type x\n")
    with pytest.raises(typesupport.BuildError, match="no_such_type"):
        typesupport.build(tmp_path / "control_msgs", tmp_path / "out")
    assert not (tmp_path / "out" / "share").exists()


def test_a_folder_without_definitions_is_refused(tmp_path):
    with pytest.raises(typesupport.BuildError, match=r"msg/\*\.msg"):
        typesupport.definitions(tmp_path)


@pytest.mark.ros
def test_messages_services_and_actions_pass_the_middleware():
    """Creating endpoints needs more of the typesupport than serialising: rmw_fastrtps describes the
    type as well.
    """
    import rclpy
    from control_msgs.action import FollowJointTrajectory
    from control_msgs.msg import JointTrajectoryControllerState
    from control_msgs.srv import QueryTrajectoryState
    from rclpy.action import ActionClient
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("probe", context=context)
    received = []
    node.create_subscription(JointTrajectoryControllerState, "probe_state", received.append, 1)
    publisher = node.create_publisher(JointTrajectoryControllerState, "probe_state", 1)
    service = node.create_service(
        QueryTrajectoryState, "probe_query", lambda request, response: response
    )
    action = ActionClient(node, FollowJointTrajectory, "probe_action")
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    deadline_s = time.monotonic() + 30.0
    while not received and time.monotonic() < deadline_s:
        publisher.publish(
            JointTrajectoryControllerState(joint_names=["a"], speed_scaling_factor=0.5)
        )
        executor.spin_once(timeout_sec=0.1)
    assert received[0].joint_names == ["a"]
    assert service.srv_name.endswith("probe_query")
    action.destroy()
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)
