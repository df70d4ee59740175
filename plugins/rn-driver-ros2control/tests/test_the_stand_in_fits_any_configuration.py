"""`roboneuron robot stand-in FILE`: names, joints, home and gripper are the file's."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from rn_driver_ros2control.options import Ros2ControlOptions
from rn_driver_ros2control.standin_command import StandInCommand, standin_arguments
from rn_driver_ros2control.standin_node import parse
from rn_robot_fr3.profile import profile
from roboneuron import ConfigurationError

GRIPPERS = ("none", "gripper-command", "parallel-gripper-command")


@pytest.mark.parametrize("kind", ["joint-trajectory", "forward-position"])
@pytest.mark.parametrize("gripper", GRIPPERS)
@pytest.mark.parametrize("states", [None, "/hand/joint_states"])
def test_its_arguments_are_the_options_of_the_driver(kind, gripper, states):
    options = Ros2ControlOptions(
        controller="/ns/arm",
        controller_type=kind,
        gripper=gripper,
        gripper_joint_states=states,
        joint_states="/ns/joint_states",
        gripper_action="/ns/hand",
    )
    fr3 = profile()
    there = parse(standin_arguments(fr3, options))
    assert (there.controller, there.type) == (options.controller, options.controller_type)
    assert tuple(there.joints) == fr3.arm_joints
    assert fr3.home_rad is not None
    assert np.allclose(there.start, fr3.home_rad, atol=1e-6)
    assert there.joint_states == options.joint_states
    assert there.gripper_joint_states == (states or options.joint_states)
    assert there.gripper_joint == fr3.gripper.joint
    if gripper != "none":
        assert (there.gripper_type, there.gripper_action) == (gripper, options.gripper_action)


def test_an_arm_without_a_gripper_has_none():
    arguments = standin_arguments(replace(profile(), gripper=None), Ros2ControlOptions())
    assert parse(arguments).gripper_joint == ""


@pytest.mark.parametrize("text", ['[robot]\nname = "fr3"\n', '[robots.a]\nrobot = "fr3"\n'])
def test_another_configuration_is_refused(tmp_path, text):
    path = tmp_path / "roboneuron.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError, match="ros2-control"):
        StandInCommand().run(Namespace(file=path, more=[]))
