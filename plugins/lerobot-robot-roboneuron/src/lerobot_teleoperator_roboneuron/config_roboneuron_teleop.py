"""Options under `--teleop.*`."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("roboneuron")
@dataclass(kw_only=True)
class RoboNeuronTeleopConfig(TeleoperatorConfig):
    """Joint states of a leader arm, a program or another robot.

    Attributes:
        robot: name of the robot to be moved.
        topic: absolute name of the topic, sensor_msgs/JointState, by the joint names of that robot
            [rad, m].
        use_degrees: as for the robot.
        start_timeout_s: longest wait for the first state [s].
        timeout_s: an older state is an error [s].
    """

    robot: str = "fr3"
    topic: str = "/leader/joint_states"
    use_degrees: bool = True
    start_timeout_s: float = 60.0
    timeout_s: float = 0.5
