"""Drivers of real arms that any robot package, or a configuration, can name."""

from __future__ import annotations

from dataclasses import dataclass

from roboneuron import DriverSpec, Requirement


@dataclass(frozen=True, kw_only=True, slots=True)
class RealDriver:
    """One of them, and what a person has to do for it.

    Attributes:
        spec: its descriptor.
        options: lines for roboneuron.toml under `[plugins.NAME]`, `NAME` being the robot's.
        steps: what to do before the first motion, with `NAME` likewise.
    """

    spec: DriverSpec
    options: str
    steps: str


SIMULATED = DriverSpec(
    name="simulated",
    summary="Moves within the joints' limits, without physics.",
    target="rn_simulation.kinematic_driver:KinematicArmDriver",
    requires=(Requirement(module="rn_simulation", install="pip install ./plugins/rn-simulation"),),
    simulated=True,
)
"""Of an arm without a simulation of its own."""
_REAL = (
    RealDriver(
        spec=DriverSpec(
            name="ros2-control",
            summary="Any arm behind a controller of ros2_control",
            target="rn_driver_ros2control.driver:Ros2ControlDriver",
            config="rn_driver_ros2control.options:Ros2ControlOptions",
            requires=(
                Requirement(
                    module="rn_driver_ros2control",
                    install="pip install ./plugins/rn-driver-ros2control",
                ),
            ),
            recovers=True,
        ),
        options='controller = "/joint_trajectory_controller"\njoint_states = "/joint_states"',
        steps="The command is for RoboNeuron's source folder. `ros2 control list_controllers`\n"
        "names the active controller of these joints: write it under `[plugins.NAME]`. If it runs\n"
        "on another machine, set `ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET`.",
    ),
    RealDriver(
        spec=DriverSpec(
            name="lerobot",
            summary="The arm by lerobot's own driver, in lerobot's environment",
            target="rn_robot_lerobot.lerobot_driver:LerobotDriver",
            config="rn_robot_lerobot.lerobot_options:LerobotDriverOptions",
            requires=(
                Requirement(
                    module="lerobot",
                    install='pip install "lerobot[feetech,dynamixel]>=0.6.1,<0.7" (Python 3.12)',
                ),
            ),
        ),
        options='type = "so101_follower"\nid = "my_arm"\nport = "/dev/ttyACM0"',
        steps="Calibrate the arm by `lerobot-calibrate`, and write type, id and port under\n"
        "`[plugins.NAME]`. Motors are joints of the same name; others, units and directions:\n"
        "`[plugins.NAME.motors]`.",
    ),
    RealDriver(
        spec=DriverSpec(
            name="fci",
            summary="A Franka Research 3 over its network protocol",
            target="rn_robot_fr3.fci.driver:FciDriver",
            config="rn_robot_fr3.fci.options:FciDriverOptions",
            requires=(
                Requirement(
                    module="pylibfranka",
                    install="pip install pylibfranka ruckig franky-control "
                    "(Python 3.11 or 3.12, x86-64)",
                ),
            ),
            recovers=True,
        ),
        options='host = "172.16.0.2"',
        steps="Write the arm's address under `[plugins.NAME]`; `roboneuron robot fr3` checks it.",
    ),
)
REAL_DRIVERS = {driver.spec.name: driver for driver in _REAL}
"""By name."""
