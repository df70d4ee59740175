"""Descriptors of this package: the robots "so101", "koch" and "lekiwi" with their drivers, and the
simulated cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from roboneuron import CameraSpec, DriverSpec, PerceptionSpec, Requirement, RobotSpec, hookimpl

_MUJOCO = Requirement(module="mujoco", install="pip install mujoco")
_LEROBOT = Requirement(
    module="lerobot", install='pip install "lerobot[feetech,dynamixel]>=0.6.1,<0.7" (Python 3.12)'
)
_CAMERAS = (CameraSpec(name="front", role="primary"), CameraSpec(name="wrist", role="wrist"))
_LEROBOT_DRIVER = DriverSpec(
    name="lerobot",
    summary="The arm itself by lerobot's own driver, in lerobot's environment; any arm of LeRobot "
    "with these joints",
    target="rn_robot_lerobot.lerobot_driver:LerobotDriver",
    config="rn_robot_lerobot.lerobot_options:LerobotDriverOptions",
    requires=(_LEROBOT,),
)
_KOCH_DRIVER = replace(_LEROBOT_DRIVER, config="rn_robot_lerobot.lerobot_options:KochOptions")
_LEKIWI_DRIVER = replace(
    _LEROBOT_DRIVER,
    summary="The arm and its base by lerobot's own driver, in lerobot's environment",
    target="rn_robot_lerobot.lekiwi_driver:LekiwiDriver",
    config="rn_robot_lerobot.lerobot_options:LekiwiOptions",
)


_SIMULATED_DRIVER = DriverSpec(
    name="simulated",
    summary="MuJoCo simulation: a table with coloured cubes in random places",
    target="rn_robot_lerobot.driver:SimulatedSo101Driver",
    config="rn_robot_lerobot.options:SimulatedSo101Options",
    simulated=True,
    requires=(_MUJOCO,),
)


def _robot(name: str, summary: str, *drivers: DriverSpec) -> RobotSpec:
    return RobotSpec(
        name=name,
        summary=summary,
        target=f"rn_robot_lerobot.profile:{name}_profile",
        case=f"rn_robot_lerobot.contract_cases:{name}_case",
        robot_kind="arm",
        cameras=_CAMERAS,
        action_widths=(7,),
        drivers=drivers,
    )


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """The SO-101, the Koch follower and the LeKiwi."""
    return [
        _robot(
            "so101",
            "SO-101 follower: 5-joint arm with gripper, a camera beside the table and one on the "
            "gripper",
            _SIMULATED_DRIVER,
            _LEROBOT_DRIVER,
        ),
        _robot(
            "koch",
            "Koch v1.1 follower: 5-joint arm with gripper, Dynamixel motors, cameras that are not "
            "calibrated",
            _KOCH_DRIVER,
        ),
        _robot(
            "lekiwi",
            "LeKiwi: SO-101 arm on a base with three omnidirectional wheels, cameras that are not "
            "calibrated",
            _LEKIWI_DRIVER,
        ),
    ]


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """The cameras of the simulated SO-101."""
    return [
        PerceptionSpec(
            name="so101-sim-camera",
            summary="Front and wrist camera of the simulated SO-101, drawn on the CPU",
            target="rn_robot_lerobot.camera_source:SimulatedSo101Cameras",
            config="rn_simulation.arm_options:SimulatedCamerasOptions",
            case="rn_robot_lerobot.contract_cases:cameras_case",
            requires=(_MUJOCO,),
            robots=("so101",),
            drivers=("simulated",),
        )
    ]
