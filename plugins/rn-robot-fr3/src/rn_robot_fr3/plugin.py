"""Descriptors of this package: the robot "fr3" with its drivers, and the cameras of the
simulation.
"""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import (
    CameraSpec,
    CommandSpec,
    DriverSpec,
    PerceptionSpec,
    Requirement,
    RobotSpec,
    hookimpl,
)

_INSTALL = "pip install ./plugins/rn-driver-ros2control (in RoboNeuron's source folder)"
ROS2_CONTROL = Requirement(module="rn_driver_ros2control", install=_INSTALL)
CONTROL_MSGS = Requirement(module="control_msgs", install=_INSTALL)
_FCI = tuple(
    Requirement(
        module=module,
        install="pip install pylibfranka ruckig franky-control (Python 3.11 or 3.12, x86-64)",
    )
    for module in ("pylibfranka", "ruckig", "franky")
)
_ENGINE = Requirement(module="pybullet", alternatives=("mujoco",), install="pip install mujoco")
"""Copy of `rn_simulation.engine.REQUIREMENT`, because a plugin module imports no other package."""


_SIMULATED = DriverSpec(
    name="simulated",
    summary="PyBullet or MuJoCo simulation: a table with coloured cubes in random places",
    target="rn_robot_fr3.driver:SimulatedFr3Driver",
    config="rn_robot_fr3.options:SimulatedFr3Options",
    simulated=True,
    requires=(_ENGINE,),
)


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """The Franka Research 3, and two of them at one table."""
    return [
        RobotSpec(
            name="fr3",
            summary="Franka Research 3: 7-joint arm with gripper, a camera beside the table and "
            "one at the wrist",
            target="rn_robot_fr3.profile:profile",
            case="rn_robot_fr3.contract_cases:robot_case",
            robot_kind="arm",
            cameras=(
                CameraSpec(name="front", role="primary"),
                CameraSpec(name="wrist", role="wrist"),
            ),
            action_widths=(7,),
            drivers=(
                _SIMULATED,
                DriverSpec(
                    name="ros2-control",
                    summary="joint_trajectory_controller of ros2_control, as in franka_ros2",
                    target="rn_driver_ros2control.driver:Ros2ControlDriver",
                    config="rn_driver_ros2control.options:Ros2ControlOptions",
                    requires=(ROS2_CONTROL, CONTROL_MSGS),
                    recovers=True,
                ),
                DriverSpec(
                    name="fci",
                    summary="The arm itself, over its network protocol (FCI, protocol 10); or "
                    "franka-sim",
                    target="rn_robot_fr3.fci.driver:FciDriver",
                    config="rn_robot_fr3.fci.options:FciDriverOptions",
                    requires=_FCI,
                    recovers=True,
                ),
            ),
        ),
        RobotSpec(
            name="fr3-pair",
            summary="Two Franka Research 3 facing each other at one table, with three cameras",
            target="rn_robot_fr3.profile:pair_profile",
            case="rn_robot_fr3.contract_cases:pair_case",
            robot_kind="arm",
            cameras=(
                CameraSpec(name="front", role="primary"),
                CameraSpec(name="left_wrist", role="wrist"),
                CameraSpec(name="right_wrist", role="right_wrist"),
            ),
            action_widths=(16,),
            drivers=(_SIMULATED,),
        ),
    ]


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """The cameras of the simulated FR3."""
    return [
        PerceptionSpec(
            name="fr3-sim-camera",
            summary="Front and wrist camera of the simulated FR3, drawn on the CPU",
            target="rn_robot_fr3.camera_source:SimulatedFr3Cameras",
            config="rn_simulation.arm_options:SimulatedCamerasOptions",
            case="rn_robot_fr3.contract_cases:cameras_case",
            requires=(_ENGINE,),
            robots=("fr3",),
            drivers=("simulated", "fci"),
        ),
        PerceptionSpec(
            name="fr3-pair-sim-camera",
            summary="Front and wrist cameras of two simulated FR3s, drawn on the CPU",
            target="rn_robot_fr3.camera_source:SimulatedPairCameras",
            config="rn_simulation.arm_options:SimulatedCamerasOptions",
            case="rn_robot_fr3.contract_cases:pair_cameras_case",
            requires=(_ENGINE,),
            robots=("fr3-pair",),
            drivers=("simulated",),
        ),
    ]


@hookimpl
def roboneuron_commands() -> Sequence[CommandSpec]:
    """The command `roboneuron robot fr3`."""
    return [
        CommandSpec(
            name="robot-fr3",
            group="robot",
            summary="check whether this machine and its network can control a real FR3",
            target="rn_robot_fr3.fci.check_command:Fr3",
            old_names=("fr3",),
        )
    ]
