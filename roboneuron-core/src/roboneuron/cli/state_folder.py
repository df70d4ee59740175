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


def state_directory_of(arguments: Namespace) -> Path:
    """The state directory that a command line means.

    Raises:
        ConfigurationError: the file of --config cannot be read.
    """
    configured = read_state_directory(arguments.config) if arguments.config else None
    return state_directory(str(arguments.state) if arguments.state else configured)


def folders_of(directory: Path, robot: str | None = None) -> list[Path]:
    """The folder of the server itself and those of its robots, or the one of the named robot.

    Raises:
        ConfigurationError: the robot has no folder; what has no effect must not look like success.
    """
    of_robots = robot_folder(directory).parent
    known = {path.name: path for path in sorted(of_robots.glob("*"))}
    if robot is None:
        return [directory, *known.values()]
    if robot not in known:
        names = ", ".join(known) or "none"
        raise ConfigurationError(f"There is no robot {robot!r} in {of_robots}; there are: {names}.")
    return [known[robot]]
