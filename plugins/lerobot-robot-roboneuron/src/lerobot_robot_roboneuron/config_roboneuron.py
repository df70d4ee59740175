"""Options under `--robot.*`."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("roboneuron")
@dataclass(kw_only=True)
class RoboNeuronConfig(RobotConfig):
    """A robot controlled through RoboNeuron.

    Attributes:
        robot: name of the robot; its plugin must also be installed in lerobot's environment.
        namespace: namespace of its topics; empty for the robot's name.
        serve: command of a server that this process starts, owns and stops, such as
            ["/venv/bin/roboneuron", "serve", "--config", "so101.toml"]. Empty: robot, perception
            and control are already running.
        use_degrees: joints in degrees, as LeRobot's own arms; False for radians. Grippers are 0
            closed .. 100 open, prismatic joints are metres.
        images: name in the data set by camera of the robot; empty for all under their own names.
        perception: False for no images and no perception module.
        width, height: image size [px]; 0 for that of the robot's profile.
        start_timeout_s: longest wait for states, images and control [s].
        state_timeout_s, image_timeout_s: older states and images are errors [s].
        answer_timeout_s: longest wait for the command that control computes from an action [s].
    """

    robot: str = "fr3"
    namespace: str = ""
    serve: list[str] = field(default_factory=list)
    use_degrees: bool = True
    images: dict[str, str] = field(default_factory=dict)
    perception: bool = True
    width: int = 0
    height: int = 0
    start_timeout_s: float = 60.0
    state_timeout_s: float = 0.5
    image_timeout_s: float = 1.0
    answer_timeout_s: float = 0.1
