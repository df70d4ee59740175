"""Arguments of the commands that work on the files of a state directory, with or without a server,
and the folders that they mean.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from roboneuron.config.reading import read_state_directory, robot_folder
from roboneuron.errors import ConfigurationError
from roboneuron.ros.environment import state_directory


def add_arguments(parser: ArgumentParser, *, with_robot: bool = True) -> None:
    """Add --config and --state, and --robot if the command can act on one of several robots."""
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="a roboneuron.toml that names the state directory",
    )
    parser.add_argument(
        "--state", type=Path, metavar="DIRECTORY", help="the state directory itself"
    )
    if with_robot:
        parser.add_argument(
            "--robot",
            metavar="NAME",
            help="only this one of several robots; all of them without it",
        )


def folders_of(arguments: Namespace) -> list[Path]:
    """The folder of the server itself, the state directory, and then those of its robots; with
    --robot the one of that robot.

    Raises:
        ConfigurationError: the file of --config cannot be read, or the robot has no folder: what
            has no effect must not look like success.
    """
    configured = read_state_directory(arguments.config) if arguments.config else None
    directory = state_directory(str(arguments.state) if arguments.state else configured)
    of_robots = robot_folder(directory).parent
    known = {path.name: path for path in sorted(of_robots.glob("*"))}
    robot = getattr(arguments, "robot", None)
    if robot is None:
        return [directory, *known.values()]
    if robot not in known:
        names = ", ".join(known) or "none"
        raise ConfigurationError(f"There is no robot {robot!r} in {of_robots}; there are: {names}.")
    return [known[robot]]
