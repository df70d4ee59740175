"""The command `roboneuron runs import`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron import MissingDependencyError, install_command

if TYPE_CHECKING:
    from rn_recorder_runs.lerobot import Written


def add_bag_options(parser: ArgumentParser) -> None:
    """Add the arguments that name bags and their mapping."""
    add = parser.add_argument
    add(
        "bags",
        nargs="+",
        type=Path,
        metavar="BAG",
        help="a folder with metadata.yaml, or a file .mcap or .db3",
    )
    add(
        "--map",
        type=Path,
        required=True,
        metavar="FILE",
        help="TOML that says what their topics are",
    )
    add(
        "--lerobot",
        type=Path,
        required=True,
        metavar="DIRECTORY",
        help="a LeRobotDataset v3 of their episodes",
    )


def import_named(arguments: Namespace) -> Written:
    """Import the bags of the command line. Raises as `read_mapping` and `import_bags`, and
    MissingDependencyError without the extra [export].
    """
    from rn_recorder_bags.mapping import read_mapping

    try:
        from rn_recorder_bags.importing import import_bags
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"Bags need {error.name}.", hint=f"Run: {install_command('rn-recorder[export]')}."
        ) from error
    return import_bags(
        arguments.bags,
        read_mapping(arguments.map),
        arguments.lerobot,
        codec=arguments.codec,
        with_lerobot=arguments.with_lerobot,
    )
