"""The command `roboneuron robot stand-in`."""

from __future__ import annotations

from argparse import REMAINDER, ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path

from rn_driver_ros2control.options import Ros2ControlOptions
from roboneuron import ConfigurationError, RobotProfile

DRIVER = "ros2-control"


class StandInCommand:
    """Stand in for the controller, joint states and gripper that a configuration with the driver
    ros2-control names, from the arm's home posture; nothing moves.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron robot stand-in`."""
        parser.add_argument("file", type=Path, help="the roboneuron.toml")
        parser.add_argument(
            "more",
            nargs=REMAINDER,
            help="options of python -m rn_driver_ros2control.standin_node, such as --inactive",
        )

    def run(self, arguments: Namespace) -> int:
        """Run until Ctrl-C.

        Raises:
            ConfigurationError: the file has another driver, or several robots.
        """
        from roboneuron.command import discover, environment, load_config
        from roboneuron.feature import load_profile

        config = load_config(arguments.file)
        if config.robots or config.robot.driver != DRIVER:
            raise ConfigurationError(
                f"{arguments.file} has no robot with driver = {DRIVER!r} as its only one."
            )
        registry = discover(config.disabled_plugins, config.robot)
        profile = load_profile(registry, config.robot)
        options = Ros2ControlOptions.model_validate(dict(config.options(config.robot.name)))
        environment.prepare_environment(
            environment.state_directory(config.supervisor.state_directory)
        )
        from rn_driver_ros2control.standin_node import main  # heavy

        main([*standin_arguments(profile, options), *arguments.more])
        return 0


def standin_arguments(profile: RobotProfile, options: Ros2ControlOptions) -> Sequence[str]:
    """Arguments of the stand-in node for a robot behind the driver.

    Raises:
        ConfigurationError: the robot has no arm with a home posture.
    """
    if profile.home_rad is None or not profile.arm_joints:
        raise ConfigurationError(f"The robot {profile.name!r} has no arm with a home posture.")
    words = ["--controller", options.controller, "--type", options.controller_type]
    words += ["--joints", *profile.arm_joints]
    words += ["--start", *(f"{value:.6f}" for value in profile.home_rad.tolist())]
    words += ["--joint-states", options.joint_states]
    gripper = profile.gripper
    if gripper is not None:
        words += ["--gripper-joint", gripper.joint, "--opening", f"{gripper.open_position:.6f}"]
        words += ["--gripper-joint-states", options.gripper_joint_states or options.joint_states]
    if gripper is not None and options.gripper != "none":
        words += ["--gripper-type", options.gripper, "--gripper-action", options.gripper_action]
    return words
