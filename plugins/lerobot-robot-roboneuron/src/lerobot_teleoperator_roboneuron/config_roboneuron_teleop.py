"""Options under `--teleop.*`."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("roboneuron")
@dataclass(kw_only=True)
class RoboNeuronTeleopConfig(TeleoperatorConfig):
    """Joint states of a leader arm, a program or another robot; or the sliders of a page.

    Attributes:
        robot: name of the robot to be moved.
        namespace: namespace of that robot in the view; empty for its name.
        view: address of a live view, such as "http://127.0.0.1:8780", where a person moves the
            sliders; empty for `topic`.
        token_variable: environment variable with a token of the view; empty for a view without
            tokens.
        topic: absolute name of the topic, sensor_msgs/JointState, by the joint names of that robot
            [rad, m].
        use_degrees: as for the robot.
        start_timeout_s: longest wait for the first state [s].
        timeout_s: an older state is an error [s].
    """

    robot: str = "fr3"
    namespace: str = ""
    view: str = ""
    token_variable: str = ""
    topic: str = "/leader/joint_states"
    use_degrees: bool = True
    start_timeout_s: float = 60.0
    timeout_s: float = 0.5
